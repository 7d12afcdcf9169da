import math

import mpmath
import numpy as np
import pytest
import torch
from scipy import integrate, special, stats

from framework.configuration.schema import build, resolve
from framework.distributions.density import Mixture
from framework.errors import ConfigError
from framework.target import Target
from plugins.density_head.projected_normal import functions
from plugins.density_head.projected_normal.density import ProjectedNormal
from plugins.density_head.projected_normal.head import LARGEST_MEAN, mean_of_raw
from plugins.density_head.projected_normal.rows import ONE

PARAMETERS = {
    "uniform": ([0.0, 0.0], [0.0, 0.0]),
    "broad": ([0.3, -0.2], [0.2, 0.5]),
    "two peaks": ([0.1, 0.05], [1.0, -1.5]),
    "skewed": ([2.0, 1.0], [0.7, 2.0]),
    "narrow": ([-30.0, 5.0], [-0.5, 1.0]),
}


def double(numbers):
    return torch.as_tensor(numbers, dtype=torch.float64)


def density_of(mean, factor):
    return ProjectedNormal(double([mean]), double([factor]))


@pytest.mark.parametrize("value", [-1e4, -300.0, -30.001, -29.999, -5.0, -1e-9, 0.0, 1e-9, 3.0, 40.0, 1e6])
def test_log_g_and_its_derivative_agree_with_mpmath(value):
    with mpmath.workdps(40 if value > -100 else 30):
        exact = mpmath.mpf(value)
        if value > -100:
            g = mpmath.exp(-exact * exact / 2) + mpmath.sqrt(2 * mpmath.pi) * exact * mpmath.ncdf(exact)
            expected = float(mpmath.log(g))
        else:  # g(D) = ∫ r exp(-(r - D)²/2) dr
            scale = 1 / abs(exact)
            part = mpmath.quad(
                lambda r: r * mpmath.exp(-r * r / 2 + exact * r), [0, scale, 8 * scale, 60 * scale]
            )
            expected = float(mpmath.log(part) - exact * exact / 2)
    assert functions.log_g(double(value)).item() == pytest.approx(expected, rel=1e-12, abs=1e-12)
    assert torch.autograd.gradcheck(functions.log_g, double(value).requires_grad_(), atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("name", PARAMETERS)
def test_density_is_the_integral_of_a_normal_density_along_a_ray(name):
    mean, (grow, shear) = PARAMETERS[name]
    lower = np.array([[math.exp(grow), 0], [shear, math.exp(-grow)]])
    normal = stats.multivariate_normal(mean, np.linalg.inv(lower @ lower.T))
    reach = 40 + 2 * np.linalg.norm(mean)
    for angle in (-2.0, 0.1, 1.5, math.atan2(mean[1], mean[0])):
        ray = np.array([math.cos(angle), math.sin(angle)])
        peak = max(float(ray @ mean), 0.0)
        expected, _ = integrate.quad(
            lambda r, ray=ray: r * normal.pdf(r * ray),
            0,
            reach,
            points=[peak],
            epsabs=0,
            epsrel=1e-10,
            limit=200,
        )
        actual = density_of(mean, (grow, shear)).log_prob(double([angle])).exp().item()
        assert actual == pytest.approx(expected, rel=1e-8, abs=1e-300)


@pytest.mark.parametrize("length", [0.0, 0.3, 1.0, 4.0, 20.0])
def test_mean_resultant_length_of_the_isotropic_density(length):
    # ρ = √(π/8) γ exp(-γ²/4) (I₀(γ²/4) + I₁(γ²/4)) for |μ| = γ (Mardia & Jupp 2000, 3.5.50)
    density = density_of([length * math.cos(0.7), length * math.sin(0.7)], [0, 0])
    width = 12 / max(length, 1)
    points = [0.7 - width, 0.7, 0.7 + width] if width < 3 else None

    def part(angle):
        return math.cos(angle - 0.7) * density.log_prob(double([angle])).exp().item()

    actual, _ = integrate.quad(part, 0.7 - math.pi, 0.7 + math.pi, points=points, limit=200)
    quarter = length**2 / 4
    expected = math.sqrt(math.pi / 8) * length * (special.ive(0, quarter) + special.ive(1, quarter))
    assert actual == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("name", PARAMETERS)
def test_mode_is_the_highest_point_of_a_fine_grid(name):
    density = density_of(*PARAMETERS[name])
    grid = torch.linspace(-math.pi, math.pi, 200_001, dtype=torch.float64)[:, None]
    assert density.log_prob(density.mode) >= density.log_prob(grid).max() - 1e-9


def test_the_uniform_density_and_a_density_with_two_peaks():
    assert density_of([0, 0], [0, 0]).log_prob(double([1.0])).item() == pytest.approx(-math.log(2 * math.pi))
    two = density_of([0, 0], [1.0, 0.0])
    opposite = two.log_prob(double([[math.pi / 2], [-math.pi / 2], [0.0]]))
    assert opposite[0].item() == pytest.approx(opposite[1].item())
    assert opposite[0] > opposite[2] + 3


def test_mean_of_raw_is_smooth_at_zero_and_bounded():
    assert torch.autograd.gradcheck(
        mean_of_raw, double([[0.0, 0.0], [1.0, -2.0], [30.0, 4.0]]).requires_grad_()
    )
    assert mean_of_raw(double([1e200, 0.0])).norm() <= LARGEST_MEAN * (1 + 1e-12)


@pytest.mark.parametrize("name", ["mixture", "scvae", "cvae"])
def test_other_heads_mix_projected_normal_densities(name):
    settings = {"components": 3} if name == "mixture" else {"hidden": 8, "samples": 20, "training_samples": 5}
    config = {"name": name, "component": {"name": "projected_normal"}, **settings}
    torch.manual_seed(0)
    head = build("density_head", resolve("density_head", config), target=ONE).double()
    raw = torch.randn(4, head.size).double().requires_grad_()
    head.train().loss(raw, torch.randn(4, 1).double()).sum().backward()
    assert raw.grad.isfinite().all()
    density = head.eval()(raw.detach())
    if name == "mixture":
        assert isinstance(density, Mixture)
    angles = -math.pi + 2 * math.pi * (torch.arange(7200).double() + 0.5) / 7200
    if name != "cvae":  # its log_prob is a lower bound
        mass = density.log_prob(angles[:, None, None].expand(-1, 4, 1)).exp().mean(0) * 2 * math.pi
        torch.testing.assert_close(mass, torch.ones(4).double(), rtol=1e-6, atol=0)


def test_other_targets_are_refused():
    with pytest.raises(ConfigError, match=r"projected_normal.*'real'"):
        build("density_head", resolve("density_head", "projected_normal"), target=Target("real", ("x",)))
