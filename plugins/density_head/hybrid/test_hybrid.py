"""Tests of a learned density around the encoder's mean: its initial value, and independence of the target's unit."""

import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.target import Target


def test_an_untrained_hybrid_is_centred_on_the_encoders_mean() -> None:
    target = Target("real", ("x", "y"), (3.0, -1.0), (0.1, 20.0))
    head = build("density_head", resolve("density_head", {"name": "hybrid", "further": 1}), target=target)
    units = torch.tensor([[0.005, 1.0], [0.1, 20.0]])
    raw = torch.cat([torch.tensor([[3.2, 15.0], [2.9, -30.0]]), units.log(), torch.tensor([[0.4], [7.0]])], 1)
    torch.testing.assert_close(head(raw).mode, raw[:, :2].double())
    # the component starts with a standard deviation of 1
    torch.testing.assert_close(head(raw).sample((4000,)).std(0), units.double(), rtol=0.06, atol=0)
    value = raw[:, :2] + 0.7 * units
    torch.testing.assert_close(
        head.loss(raw, value), -head(raw).log_prob(value).to(torch.float32), check_dtype=False
    )


@pytest.mark.parametrize("component", ["gaussian", "cvae"])
def test_a_hybrid_does_not_depend_on_the_targets_unit(component: str) -> None:
    results = []
    for location, scale in (((3.0, -1.0), (0.1, 20.0)), ((0.0, 0.0), (1.0, 1.0))):
        target = Target("real", ("x", "y"), location, scale)
        config = {"name": "hybrid", "further": 1, "component": {"name": component}}
        if component == "cvae":
            config["component"] |= {"component": {"name": "gaussian"}}
        torch.manual_seed(0)
        head = build("density_head", resolve("density_head", config), target=target).eval()
        # the mean is read in the target's unit, which is not standardised here
        torch.nn.init.zeros_(head.network[0].weight[:, :2].detach())
        raw = torch.tensor([[3.2, 15.0, -5.0, 0.0, 0.4], [2.9, -30.0, -2.0, 3.0, 7.0]])
        torch.manual_seed(1)
        density = head(raw)
        results.append((density.log_prob(raw[:, :2].double()).detach(), density.sample((5,)).detach()))
    for scaled, standard in zip(*results, strict=True):
        torch.testing.assert_close(scaled.double(), standard.double(), rtol=1e-4, atol=1e-4)
