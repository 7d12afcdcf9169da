import math

import numpy as np
import pytest
import torch
from scipy import special, stats

from framework.configuration.schema import build, resolve
from framework.distributions.density import Mixture
from framework.errors import ConfigError
from framework.target import Target
from framework.testing.densities import examine_densities
from framework.testing.head_subject import HeadSubject, values
from framework.testing.rows import HeadRow
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


REAL_COMPONENTS = {
    "gaussian": {"name": "gaussian"},
    "student_t": {"name": "student_t", "degrees_of_freedom": 4.5},
    "heavy tails": {"name": "student_t", "degrees_of_freedom": 2.5},
    "predicted degrees of freedom": {"name": "student_t", "degrees_of_freedom": "predicted"},
    "evidential": {"name": "evidential"},
}


@pytest.mark.parametrize("component", [name for name in REAL_COMPONENTS if name != "gaussian"])
@pytest.mark.parametrize("numbers", [1, 2])
@pytest.mark.parametrize("size", [0.1, 1.0, 10.0])
def test_densities_of_students_t_are_products_as_scipy_has_them(component, numbers, size):
    target = Target("real", ("x", "y")[:numbers])
    head = build_head({"components": 3, "component": REAL_COMPONENTS[component]}, target).double()
    with torch.no_grad():
        density = head(size * torch.randn(4, head.size, dtype=torch.float64))
        value = density.sample((50,))
        log_prob = density.log_prob(value)
    parts = density.components
    freedom = parts.freedom.expand_as(parts.location).numpy()
    each = stats.t.logpdf(value.numpy()[:, :, None], freedom, parts.location.numpy(), parts.scale.numpy())
    expected = special.logsumexp(density.log_weights.numpy() + each.sum(-1), axis=-1)
    np.testing.assert_allclose(log_prob.numpy(), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("component", REAL_COMPONENTS)
@pytest.mark.parametrize("name", ["integral", "entropy", "mean and variance"])
def test_the_checks_of_two_numbers_pass_mixtures_of_very_different_components(component, name):
    """Their quadrature must find narrow components of small weight, and must follow tails along the axes."""
    target, config = Target("real", ("x", "y")), {"components": 3, "component": REAL_COMPONENTS[component]}
    subject = HeadSubject(HeadRow("", target), lambda: build_head(config, target), only=name)
    (finding,) = examine_densities(subject)
    assert finding.holds, str(finding)
