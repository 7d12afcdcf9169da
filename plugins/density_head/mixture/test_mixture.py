import math

import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.distributions.density import Mixture
from framework.errors import ConfigError
from framework.target import Target
from framework.testing.head_subject import values
from plugins.density_head.mixture.rows import NESTED, ONE, TWO


def build_head(config, target):
    return build("density_head", resolve("density_head", {"name": "mixture", **config}), target=target)


def test_one_component_is_the_component_to_the_last_bit():
    head = build_head({"components": 1}, TWO)
    raw, value = torch.randn(7, head.size), values(TWO, (7,))
    density, component = head(raw), head.component(raw[:, 1:])
    assert torch.equal(density.log_prob(value), component.log_prob(value))
    assert torch.equal(density.entropy(), component.entropy())
    assert torch.equal(density.mode, component.mode)


def test_a_mixture_of_mixtures_is_a_mixture():
    head = build_head(NESTED, ONE)
    value = values(ONE, (4,))
    outer = head(torch.randn(4, head.size))
    inner = outer.components
    weights = (outer.log_weights[..., None] + inner.log_weights).flatten(-2)
    leaf = inner.components
    leaves = type(leaf)(leaf.mean.flatten(1, 2), leaf.concentration.flatten(1, 2))
    torch.testing.assert_close(outer.log_prob(value), Mixture(weights, leaves).log_prob(value))


def test_a_weight_that_vanishes_leaves_a_finite_loss():
    head = build_head({"components": 2}, ONE)
    raw = torch.tensor([[3e38, -3e38, 1.0, 0, 50, -1, 0, 50, 0, 0, 0]], requires_grad=True)
    loss = head.loss(raw, torch.tensor([[math.pi]]))
    loss.backward()
    assert loss.isfinite() and raw.grad.isfinite().all()


def test_a_component_that_is_fitted_afterwards_is_refused():
    with pytest.raises(ConfigError, match="fits concentration after training"):
        build_head({"component": {"name": "von_mises", "concentration": "fixed"}}, ONE)


def test_another_target_is_refused_by_the_component():
    with pytest.raises(ConfigError, match="von_mises"):
        build_head({}, Target("real", ("height",)))
