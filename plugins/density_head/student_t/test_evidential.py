"""Tests of the evidential head against the integral over mean and variance, and of its penalty."""

import numpy as np
import pytest
import torch
from scipy import integrate, stats

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from framework.target import Target

ONE, TWO = Target("real", ("height",)), Target("real", ("x", "y"))


def build_head(target=ONE, **config):
    return build(
        "density_head", resolve("density_head", {"name": "evidential", **config}), target=target
    ).double()


def test_the_density_is_the_integral_over_mean_and_variance():
    """Compare with ∫∫ N(y; μ, σ²) N(μ; γ, σ²/ν) Γ⁻¹(σ²; α, β) dμ dσ²; the inner integral is N(y; γ, σ² (1 + 1/ν))."""
    head = build_head(floor=1e-6)
    raw = torch.tensor([[0.3, -0.7, 0.4, -0.2]], dtype=torch.float64)
    gamma, nu, alpha, root_beta = (part.item() for part in head.evidence(raw))
    for value in (-3.0, 0.1, 0.3, 2.0, 9.0):

        def integrand(logarithm, value=value):
            variance = np.exp(logarithm)
            normal = stats.norm.pdf(value, gamma, np.sqrt(variance * (1 + 1 / nu)))
            return normal * stats.invgamma.pdf(variance, alpha, scale=root_beta**2) * variance

        expected = np.log(integrate.quad(integrand, -30, 30, epsabs=0, epsrel=1e-10, limit=500)[0])
        log_prob = head(raw).log_prob(torch.tensor([[value]], dtype=torch.float64)).item()
        assert log_prob == pytest.approx(expected, abs=1e-5)  # the floor adds 1e-6 to the scale


def test_the_loss_has_the_value_of_the_likelihood_and_the_gradient_of_the_penalty():
    raw = torch.randn(7, 8, dtype=torch.float64, requires_grad=True)
    target = torch.randn(7, 2, dtype=torch.float64)
    plain, penalised = build_head(TWO, evidence_weight=0.0), build_head(TWO, evidence_weight=0.3)
    losses = [head.loss(raw, target) for head in (plain, penalised)]
    torch.testing.assert_close(losses[0], losses[1])
    torch.testing.assert_close(losses[0], -plain(raw).log_prob(target))
    location, nu, alpha, _ = plain.evidence(raw)
    penalty = 0.3 * ((target - location).abs() * (2 * nu + alpha)).sum()
    gradients = [torch.autograd.grad(part.sum(), raw, retain_graph=True)[0] for part in (*losses, penalty)]
    torch.testing.assert_close(gradients[1], gradients[0] + gradients[2])


def test_the_unit_of_the_target_only_shifts_the_loss():
    scaled = build_head(Target("real", ("height",), location=(200.0,), scale=(50.0,)))
    raw, target = torch.randn(5, 4, dtype=torch.float64), torch.randn(5, 1, dtype=torch.float64)
    log_prob = scaled(raw).log_prob(200 + 50 * target)
    torch.testing.assert_close(log_prob, build_head()(raw).log_prob(target) - np.log(50.0))
    torch.testing.assert_close(scaled.loss(raw, 200 + 50 * target), -log_prob)


@pytest.mark.parametrize("config", [{"evidence_weight": -1.0}, {"floor": 0.0}])
def test_a_config_out_of_range_is_refused(config):
    with pytest.raises(ConfigError, match=r"density_head\."):
        build_head(**config)
