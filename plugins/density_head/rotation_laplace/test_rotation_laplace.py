import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy import integrate

from framework.configuration.schema import build, resolve
from framework.distributions.density import Mixture
from framework.distributions.protocol import marginal
from framework.errors import ConfigError
from framework.geometry.rotation import geodesic_distance, viewpoint_rotation
from framework.heads.viewpoints import VOLUME
from framework.target import Target
from plugins.density_head.rotation_laplace import functions
from plugins.density_head.rotation_laplace.density import RotationLaplace
from plugins.density_head.rotation_laplace.functions import SOFTENING
from plugins.density_head.rotation_laplace.rows import TARGET, log_normaliser


def double(numbers):
    return torch.as_tensor(numbers, dtype=torch.float64)


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.1, 1.0, 30.0, 1e3, 1e5])
def test_normaliser_of_an_isotropic_density_agrees_with_scipy(size):
    # A = size · I: d² = δ² + 4 size sin²(ω/2), and the angle ω has the measure (1 - cos ω) dω/π
    def part(angle):
        distance = math.sqrt(SOFTENING**2 + 4 * size * math.sin(angle / 2) ** 2)
        return (1 - math.cos(angle)) / math.pi * math.exp(-distance) / distance

    scale = 1 / math.sqrt(1 + size)
    borders = [0, *[b for b in (1e-3 * scale, scale, 10 * scale, 40 * scale) if b < math.pi], math.pi]
    total = sum(
        integrate.quad(part, low, high, epsabs=1e-16, epsrel=1e-10)[0] for low, high in pairwise(borders)
    )
    actual = functions.log_normaliser(double(size * np.eye(3)))
    assert actual.item() == pytest.approx(math.log(total), abs=1e-8)


@pytest.mark.parametrize("singular", [(3, 2, 1), (5, 5, -5), (40, 1, 0.5), (10, 0, 0), (200, 150, -100)])
def test_normaliser_agrees_with_a_quadrature_over_quaternions(singular):
    first, second, third = singular
    expected = log_normaliser((2.0 * (second + third), 2.0 * (first + third), 2.0 * (first + second)))
    actual = functions.log_normaliser(torch.diag(double(singular)))
    assert actual.item() == pytest.approx(expected, abs=1e-8)


def test_log_prob_is_the_formula_of_the_paper():
    torch.manual_seed(0)
    parameter = 3 * torch.randn(50, 3, 3).double()
    value = torch.randn(50, 3).double()
    left, singular, right = np.linalg.svd(parameter.numpy())
    proper = np.linalg.det(left) * np.linalg.det(right)
    singular[:, 2] *= np.sign(proper)
    trace = singular.sum(1) - (parameter * viewpoint_rotation(value)).sum((1, 2)).numpy()
    difference = RotationLaplace(parameter).log_prob(value) + functions.log_normaliser(parameter)
    expected = -np.sqrt(trace) - np.log(trace) / 2 + np.log(np.cos(value[:, 1].numpy()).__abs__() / VOLUME)
    np.testing.assert_allclose(difference.numpy(), expected, rtol=1e-5)


def test_gradients_agree_with_differences_where_singular_values_are_equal():
    turn = torch.nn.functional.normalize(
        torch.randn(1, 4, generator=torch.Generator().manual_seed(0)).double()
    )
    for matrix in (2 * np.eye(3), np.diag([2.0, 1.0, -0.5]), np.diag([3.0, 0.0, 0.0]) + 1e-3):
        parameter = double(matrix).requires_grad_()
        assert torch.autograd.gradcheck(functions.log_normaliser, parameter, atol=1e-6)
        assert torch.autograd.gradcheck(lambda a: functions.squared_distance(turn, a), parameter, atol=1e-6)


def test_tails_are_heavier_than_those_of_a_normal_density():
    torch.manual_seed(0)
    density = RotationLaplace(double(100 * np.eye(3)))
    mode = viewpoint_rotation(density.mode)
    angle = geodesic_distance(viewpoint_rotation(density.sample((20_000,))), mode.expand(20_000, 3, 3))
    # near the mode d = √100 ω, and ω² exp(-d)/d dω is a gamma density of d with shape 2
    assert angle.mean().item() * 10 == pytest.approx(2, rel=0.03)
    assert (angle.var() / angle.mean() ** 2).item() == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize("index", [0, 1, 2])
@pytest.mark.parametrize("size", [0.0, 1.0, 4.0])
def test_density_of_one_angle_is_the_integral_over_the_others(index, size):
    """Away from the tip the density is smooth, so that 600 nodes for each of the other angles suffice."""
    parameter = size * double([[0.5, -1.25, 0.75], [2.0, 0.125, -0.5], [0.25, 1.5, -1.0]])
    density = RotationLaplace(parameter)
    turn = (np.arange(600) / 600 * 2 - 1) * math.pi
    node, weight = np.polynomial.legendre.leggauss(600)
    axes = {
        0: (turn, 2 * math.pi / 600),
        1: (node * math.pi / 2, weight * math.pi / 2),
        2: (turn, 2 * math.pi / 600),
    }
    rest = [other for other in range(3) if other != index]
    tip = density.mode[index].item()
    for angle in (tip + 0.4, tip - 0.9, 0.1):
        if abs(angle - tip) < 0.3 or (index == 1 and abs(angle) > 1.5):
            continue
        values = np.empty((600, 600, 3))
        values[..., index] = angle
        values[..., rest[0]], values[..., rest[1]] = np.meshgrid(
            axes[rest[0]][0], axes[rest[1]][0], indexing="ij"
        )
        masses = [np.broadcast_to(axes[other][1], 600) for other in rest]
        height = density.log_prob(double(values)).exp().numpy()
        expected = masses[0] @ height @ masses[1]
        actual = marginal(density, index).log_prob(double([angle])).exp()
        assert actual.item() == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("shape", [(), (0,), (3, 2)])
def test_draws_of_any_shape(shape):
    density = RotationLaplace(torch.randn(*shape, 3, 3))
    assert density.sample((4,)).shape == (4, *shape, 3)
    assert density.sample((0,)).shape == (0, *shape, 3)


def test_a_mixture_of_rotation_laplace_densities_learns():
    config = {"name": "mixture", "components": 3, "component": {"name": "rotation_laplace"}}
    torch.manual_seed(0)
    head = build("density_head", resolve("density_head", config), target=TARGET).double()
    raw, value = torch.randn(4, head.size).double().requires_grad_(), torch.randn(4, 3).double()
    density = head(raw)
    assert isinstance(density, Mixture)
    parts = torch.stack(
        [RotationLaplace(density.components.parameter[:, k]).log_prob(value) for k in range(3)], -1
    )
    torch.testing.assert_close(density.log_prob(value), torch.logsumexp(density.log_weights + parts, -1))
    head.loss(raw, value).sum().backward()
    assert raw.grad.isfinite().all()
    assert raw.grad.abs().sum() > 0


@pytest.mark.parametrize("names", [("azimuth",), ("tilt", "azimuth", "elevation")])
def test_other_angles_are_refused(names):
    with pytest.raises(ConfigError, match=r"rotation_laplace.*azimuth, elevation, tilt"):
        build("density_head", resolve("density_head", "rotation_laplace"), target=Target("angle", names))
