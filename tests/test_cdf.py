import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy import integrate, stats
from torch.distributions import HalfNormal, Independent, MultivariateNormal, Normal

from framework.configuration.schema import build, resolve
from framework.distributions.batch_shapes import Reshaped, Stacked
from framework.distributions.circular_moments import circular_moments
from framework.distributions.density import Mixture
from framework.distributions.protocol import arc_length, arc_probability, cdf, mahalanobis, marginal, normals
from framework.target import Target
from framework.testing.metrics import Cardioid

WIDE = torch.float64


def normal(mean, scale):
    return Independent(Normal(mean, scale, validate_args=False), 1, validate_args=False)


def around(raw):
    made = build("density_head", resolve("density_head", "von_mises"), target=Target("angle", ("a",)))
    return made.to(raw.dtype)(raw)


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-6), (WIDE, 1e-14)])
def test_of_a_mixture_of_normals_is_scipys(dtype, tolerance):
    torch.manual_seed(0)
    mean, scale = torch.randn(6, 3, 1, dtype=dtype), torch.rand(6, 3, 1, dtype=dtype) + 0.1
    weights, value = torch.randn(6, 3, dtype=dtype), 3 * torch.randn(4, 6, 1, dtype=dtype)
    found = cdf(Mixture(weights, normal(mean, scale)), value)
    shares = weights.double().softmax(-1).numpy()
    below = stats.norm.cdf((value.double() - mean[..., 0].double()).numpy() / scale[..., 0].double().numpy())
    np.testing.assert_allclose(found.numpy(), (shares * below).sum(-1), rtol=tolerance, atol=tolerance)


def test_tails_ends_and_points():
    density = normal(
        torch.zeros(5, 1, dtype=WIDE), torch.tensor([[1.0], [1.0], [1.0], [0.0], [0.0]]).double()
    )
    value = torch.tensor([[-37.0], [math.inf], [-math.inf], [0.0], [1e-300]], dtype=WIDE)
    found = cdf(density, value)
    assert found[0].item() == pytest.approx(stats.norm.cdf(-37), rel=1e-10)  # 5.7e-300
    assert found[1:].tolist() == [1.0, 0.0, 0.5, 1.0]
    assert cdf(normal(torch.zeros(1, 1), torch.ones(1, 1)), torch.tensor([[math.nan]])).isnan().all()


def test_what_is_not_known_is_none():
    half = Independent(HalfNormal(torch.full((2, 1), 3.0)), 1)
    value = torch.zeros(2, 1)
    assert cdf(half, value) is None
    assert (
        cdf(Mixture(torch.zeros(2, 2), Independent(HalfNormal(torch.full((2, 2, 1), 3.0)), 1)), value) is None
    )
    assert cdf(Stacked([half, normal(value, value + 1)]), value[..., None]) is None
    assert arc_probability(Cardioid(value), value, value + 1) is None
    assert mahalanobis(half, value) is None
    assert normals(marginal(normal(torch.zeros(2, 3), torch.ones(2, 3)), 1)) is not None
    assert normals(normal(torch.zeros(2, 3), torch.ones(2, 3))) is None  # of several numbers


def test_registered_parts_serve_a_mixture_of_them():
    class Square(Normal):
        """Uniform density on [0, 1] with its own distribution function."""

    @cdf.register
    def _(density: Square, value: torch.Tensor) -> torch.Tensor:
        return value.double().clamp(0, 1).expand(density.loc.unsqueeze(-1).shape).squeeze(-1)

    inner = Square(torch.zeros(4, 2), torch.ones(4, 2))
    found = cdf(Mixture(torch.zeros(4, 2), inner), torch.full((4, 1), 0.3))
    torch.testing.assert_close(found, torch.full((4,), 0.3, dtype=WIDE), rtol=1e-6, atol=0)


def test_squared_distances_of_joint_normals():
    torch.manual_seed(1)
    root = torch.randn(5, 3, 3, dtype=WIDE).tril() + 2 * torch.eye(3, dtype=WIDE)
    mean, value = torch.randn(2, 5, 3, dtype=WIDE)
    joint = MultivariateNormal(
        mean, scale_tril=root @ torch.diag_embed(root.diagonal(dim1=-2, dim2=-1).sign())
    )
    gap = (value - mean).numpy()
    wanted = np.einsum("bi,bij,bj->b", gap, np.linalg.inv(joint.covariance_matrix.numpy()), gap)
    np.testing.assert_allclose(mahalanobis(joint, value).numpy(), wanted, rtol=1e-10)
    one = Mixture(torch.zeros(5, 1), Reshaped(joint, (5, 1)))
    np.testing.assert_allclose(mahalanobis(one, value).numpy(), wanted, rtol=1e-10)
    assert mahalanobis(Mixture(torch.zeros(5, 2), Stacked([joint, joint])), value) is None
    head = build(
        "density_head",
        resolve("density_head", {"name": "gaussian", "covariance": "full"}),
        target=Target("real", ("x", "y", "z")),
    ).double()
    full = head(torch.randn(5, 9, dtype=WIDE))
    # log p = -distance/2 + a constant: twice the fall from the mode
    fall = 2 * (full.log_prob(full.mode) - full.log_prob(value))
    torch.testing.assert_close(mahalanobis(full, value), fall, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("concentration", [0.0, 0.1, 2.0, 300.0, 5e3])
@pytest.mark.parametrize("start, end", [(-1.0, 1.0), (3.0, -3.0), (0.1, 0.05), (-7.0, 20.0), (1.0, 1.0)])
def test_masses_of_arcs_by_quadrature_and_by_moments(concentration, start, end):
    density = around(torch.tensor([[concentration, 0.0, 0.0]], dtype=WIDE))
    first, last = torch.tensor([[start]], dtype=WIDE), torch.tensor([[end]], dtype=WIDE)
    low, high = start, start + arc_length(first, last).item()
    wide = 10 / math.sqrt(max(concentration, 10))
    peaks = [2 * math.pi * number + side * wide for number in range(-2, 6) for side in (-1, 0, 1)]
    cuts = sorted({low, high, *(peak for peak in peaks if low < peak < high)})
    peak = density.log_prob(torch.zeros(1, 1, dtype=WIDE)).item()
    wanted = sum(
        integrate.quad(lambda x: math.exp(peak - concentration * (1 - math.cos(x))), a, b, epsabs=1e-13)[0]
        for a, b in pairwise(cuts)
    )
    exact = arc_probability(density, first, last)
    assert exact.item() == pytest.approx(wanted, abs=1e-11)
    seen = circular_moments(density)
    assert seen.resolved.all()
    # of a cut inside a narrow peak the last moments, 1e-4, are what the grid leaves out
    assert seen.arc_probability(first[:, 0], last[:, 0]).item() == pytest.approx(
        wanted, abs=1e-10 if concentration < 1e3 else 1e-6
    )
    mixed = Mixture(torch.zeros(1, 2), Stacked([density, Reshaped(density, (1,))]))
    assert arc_probability(mixed, first, last).item() == pytest.approx(wanted, abs=1e-11)


def test_moments_are_bessel_quotients():
    from scipy.special import ive

    concentration = torch.tensor([0.0, 0.3, 4.0, 100.0], dtype=WIDE)
    mean = torch.tensor([0.0, 1.0, -2.0, 3.0], dtype=WIDE)
    raw = torch.stack([concentration * mean.cos(), concentration * mean.sin(), torch.zeros(4)], -1)
    found = circular_moments(around(raw))
    for order in (0, 1, 2, 7, 40):
        length = ive(order, concentration.numpy()) / ive(0, concentration.numpy())
        wanted = length * np.exp(1j * order * mean.numpy())
        np.testing.assert_allclose(found.moments[order].numpy(), wanted, atol=1e-13)
    np.testing.assert_allclose(found.direction[1:].numpy(), mean[1:].numpy(), atol=1e-12)
    assert found.direction[0].item() == 0.0  # of the uniform density, which has none


@pytest.mark.parametrize("concentration", [0.1, 5.0, 100.0, 1000.0, 3500.0, 5000.0, 2e4])
def test_rounding_calls_no_finer_grid(concentration):
    """The last moments of a float32 density are rounding noise up to 2e-6, and must not request a finer grid."""
    mean = torch.linspace(-3, 3, 50)
    raw = torch.stack([mean.cos(), mean.sin(), torch.full_like(mean, 4 * (concentration**0.25 - 1))], -1)
    density = around(raw)
    seen = circular_moments(density)
    assert seen.resolved.all()
    assert (len(seen.moments) == 361) == (concentration <= 3500)
    start, end = mean - 0.7 / concentration**0.5, mean + 1.2 / concentration**0.5
    wanted = arc_probability(around(raw.double()), start.double()[:, None], end.double()[:, None])
    found = seen.arc_probability(start.double(), end.double())
    torch.testing.assert_close(found, wanted, rtol=0, atol=2e-5)


def test_the_series_gives_the_density_back_between_the_grids_angles():
    density = around(torch.tensor([[50.0, 20.0, 0.0]], dtype=WIDE))
    found = circular_moments(density).density(4)
    angle = -math.pi + torch.arange(len(found), dtype=WIDE) * (2 * math.pi / len(found))
    wanted = density.log_prob(angle[:, None, None]).exp()
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-12)


def test_a_density_on_a_part_of_the_circle_has_its_mass_there():
    head = build(
        "density_head",
        resolve("density_head", "matrix_fisher"),
        target=Target("angle", ("azimuth", "elevation", "tilt")),
    ).double()
    elevation = marginal(head(torch.zeros(1, 9, dtype=WIDE)), 1)
    seen = circular_moments(elevation)
    assert seen.resolved.all()
    # of F = 0, rotations are uniform and the elevation has density cos(e)/2
    low, high = torch.tensor([-math.pi], dtype=WIDE), torch.tensor([0.5], dtype=WIDE)
    assert seen.arc_probability(low, high).item() == pytest.approx((1 + math.sin(0.5)) / 2, abs=2e-5)


def test_nan_is_passed_on():
    seen = circular_moments(Cardioid(torch.tensor([[0.0], [math.nan]])))
    assert seen.resolved.all()
    found = seen.arc_probability(torch.zeros(2).double(), torch.ones(2).double())
    assert found.isnan().tolist() == [False, True]
