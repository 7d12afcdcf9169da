import itertools
import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from framework.configuration.schema import build, resolve
from framework.distributions.protocol import ranked_score
from framework.errors import ConfigError
from framework.target import Target
from plugins.density_head.quantiles.density import PiecewiseQuantiles
from plugins.density_head.quantiles.rows import ONE

QUANTILES = torch.tensor([-1.0, 0.0, 0.1, 0.5, 4.0], dtype=torch.float64)
LEVELS = torch.tensor([0.1, 0.4, 0.6, 0.7, 0.9], dtype=torch.float64)


def build_head(target=ONE, **config):
    return build("density_head", resolve("density_head", {"name": "quantiles", **config}), target=target)


@pytest.mark.parametrize("tail", [0.0, 0.2, 0.45])
def test_all_functions_are_those_of_one_density(tail):
    density = PiecewiseQuantiles(QUANTILES[2:3], QUANTILES.diff(), LEVELS, tail)

    def pdf(x):
        return density.log_prob(torch.tensor([x], dtype=torch.float64)).exp().item()

    def integrate(function):
        inner = quad(function, -1, 4, points=[0, 0.1, 0.5], limit=200)[0]
        return inner + quad(function, -math.inf, -1, limit=400)[0] + quad(function, 4, math.inf, limit=400)[0]

    assert integrate(pdf) == pytest.approx(1, abs=1e-7)
    mean = integrate(lambda x: x * pdf(x))
    assert density.mean.item() == pytest.approx(mean, rel=1e-6)
    if tail < 0.4:  # the quadrature of the second moment converges slowly for heavier tails
        assert density.variance.item() == pytest.approx(
            integrate(lambda x: (x - mean) ** 2 * pdf(x)), rel=1e-5
        )
    entropy = integrate(lambda x: -pdf(x) * density.log_prob(torch.tensor([x], dtype=torch.float64)).item())
    assert density.entropy().item() == pytest.approx(entropy, rel=1e-6)
    torch.testing.assert_close(density.cdf(QUANTILES[:, None]), LEVELS)
    probability = torch.tensor([1e-9, 0.05, 0.1, 0.33, 0.5, 0.95, 1 - 1e-9], dtype=torch.float64)
    torch.testing.assert_close(
        density.cdf(density.icdf(probability)[:, None]), probability, rtol=1e-9, atol=1e-12
    )
    assert density.cdf(torch.tensor([-3.0], dtype=torch.float64)).item() == pytest.approx(
        quad(pdf, -math.inf, -3, limit=400)[0], rel=1e-6
    )


@pytest.mark.parametrize("tail", [0.0, 0.2])
@pytest.mark.parametrize("value", [-20.0, -0.5, 0.05, 2.0, 30.0])
def test_the_score_is_the_integral_of_the_squared_difference(tail, value):
    density = PiecewiseQuantiles(QUANTILES[2:3], QUANTILES.diff(), LEVELS, tail)

    def cdf(x):
        return density.cdf(torch.tensor([x], dtype=torch.float64)).item()

    points = sorted([-1.0, 0.0, 0.1, 0.5, 4.0, value])
    ends = [-math.inf, *points, math.inf]
    expected = sum(
        quad(lambda x: (cdf(x) - (x >= value)) ** 2, low, high, limit=200)[0]
        for low, high in itertools.pairwise(ends)
    )
    assert ranked_score(density, torch.tensor([value], dtype=torch.float64)).item() == pytest.approx(
        expected, rel=1e-6
    )


@pytest.mark.parametrize("target", [ONE, Target("real", ("y",), location=(1e3,), scale=(20.0,))])
def test_conformalised_quantiles_hold_their_share_of_new_targets(target):
    torch.manual_seed(0)
    head = build_head(target, levels=9).double()
    location, scale = (target.location or (0.0,))[0], (target.scale or (1.0,))[0]
    raw = torch.zeros(8000, 9, dtype=torch.float64)
    raw[:, 4] = torch.randn(8000).double()
    noise = torch.empty(8000).exponential_().double() * 3  # skewed, and far from the uncalibrated quantiles
    values = location + scale * (raw[:, 4] + noise)[:, None]
    head.calibrate(raw[:4000], values[:4000])
    below = head(raw[4000:]).cdf(values[4000:])
    shares = (below.unsqueeze(-1) <= head.levels).double().mean(0)
    np.testing.assert_allclose(shares, head.levels, atol=0.03)


def test_quantiles_never_cross():
    head = build_head(levels=5).double()
    head.corrections.copy_(torch.tensor([9.0, -9.0, 3.0, 0.0, -50.0]))
    quantiles = head(10 * torch.randn(50, 5).double()).quantiles
    assert (quantiles.diff(dim=-1) >= 0.4e-3).all()


def test_the_loss_is_twice_the_mean_pinball_loss():
    head = build_head(levels=3).double()
    raw, target = torch.zeros(1, 3).double(), torch.tensor([[2.0]]).double()
    quantiles = head(raw).quantiles[0].tolist()
    expected = [
        2 * level * (2 - quantile) for level, quantile in zip((0.25, 0.5, 0.75), quantiles, strict=True)
    ]
    assert head.loss(raw, target).item() == pytest.approx(sum(expected) / 3)


def test_other_targets_and_settings_are_refused():
    with pytest.raises(ConfigError, match="but the target has 2 numbers"):
        build_head(Target("real", ("x", "y")))
    with pytest.raises(ConfigError, match=r"density_head\.levels is 4"):
        build_head(levels=4)
    with pytest.raises(ConfigError, match=r"density_head\.tail"):
        build_head(tail=0.5)
