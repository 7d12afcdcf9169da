"""Intervals and standard deviations of predictions, for densities with and without closed forms."""

import math

import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Laplace, Normal

from framework.data import Frame
from framework.distributions.noise import Draw
from framework.prediction import Prediction

LOCATION = torch.tensor([[0.0, 5.0], [-2.0, 1e3]], dtype=torch.float64)
SCALE = torch.tensor([[1.0, 0.1], [3.0, 20.0]], dtype=torch.float64)


class Unknown(Independent):
    """Normal density without a variance, like most mixtures over a latent variable."""

    @property
    def variance(self) -> Tensor:
        raise NotImplementedError


DENSITIES = {
    "normal": Independent(Normal(LOCATION, SCALE), 1),
    "Laplace": Independent(Laplace(LOCATION, SCALE / math.sqrt(2)), 1),
    "unknown": Unknown(Normal(LOCATION, SCALE), 1),
}


def prediction(name: str) -> Prediction:
    return Prediction(DENSITIES[name], {"input": LOCATION, "target": LOCATION}, draw=Draw(0, 0))


@pytest.mark.parametrize("name", DENSITIES)
@pytest.mark.parametrize("mass", [0.5, 0.8, 0.9])
def test_intervals_hold_their_mass(name: str, mass: float) -> None:
    low, high, *errors = prediction(name).interval(mass)
    base = Laplace(LOCATION, SCALE / math.sqrt(2)) if name == "Laplace" else Normal(LOCATION, SCALE)
    outside, error = (1 - mass) / 2, 1e-12
    assert not torch.stack(errors).any()
    torch.testing.assert_close(base.cdf(low), torch.full_like(low, outside), rtol=0, atol=error)
    torch.testing.assert_close(base.cdf(high), torch.full_like(low, 1 - outside), rtol=0, atol=error)


@pytest.mark.parametrize("name", DENSITIES)
@pytest.mark.parametrize("framed", [False, True])
def test_deviations_are_known_or_drawn(name: str, framed: bool) -> None:
    frame = Frame(LOCATION * 0 + 7.0, LOCATION * 0 + 10.0)
    found = prediction(name).in_frame(frame if framed else None).deviation(9999)
    wanted = SCALE * (10 if framed else 1)
    torch.testing.assert_close(found, wanted, rtol=0.04 if name == "unknown" else 1e-6, atol=0)


@pytest.mark.parametrize("name", DENSITIES)
def test_the_same_draws_give_the_same_ends(name: str) -> None:
    for one, other in zip(prediction(name).interval(0.9), prediction(name).interval(0.9), strict=True):
        assert torch.equal(one, other)
    assert torch.equal(prediction(name).deviation(), prediction(name).deviation())
