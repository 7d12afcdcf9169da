import math
from itertools import pairwise

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, stats
from scipy.interpolate import CubicHermiteSpline
from torch.distributions import Categorical, Independent, MixtureSameFamily, MultivariateNormal, Normal

from framework.configuration.schema import build, resolve
from framework.distributions.batch_shapes import Reshaped, Stacked
from framework.distributions.circular import angular_distance
from framework.distributions.circular_moments import circular_moments
from framework.distributions.density import Mixture
from framework.distributions.protocol import marginal
from framework.target import Target
from framework.testing.metrics import Cardioid
from plugins.metric.crps.score import crps, fair_estimate, mean_angular_distance, mean_distance

WIDE = torch.float64


def normal(mean, scale, dtype=WIDE):
    mean, scale = (torch.as_tensor(number, dtype=dtype) for number in (mean, scale))
    return Independent(Normal(mean, scale), 1)


def about_zero(concentration, dtype=WIDE, mean=0.0):
    """Return the von Mises density with this concentration and mean, from the raw parameters of a head."""
    head = build("density_head", resolve("density_head", "von_mises"), target=Target("angle", ("a",))).to(
        dtype
    )
    pair = [concentration * math.cos(mean), concentration * math.sin(mean), 0.0]
    return head(torch.tensor([pair], dtype=dtype))


def exact(density, value, samples=1000):
    found = crps(density, value, samples)
    assert (found.error == 0).all()
    return found.mean


def by_mpmath(mean, scale, value):
    """Return ∫ (F - 1[y ≤ x])² dx for a normal density, computed by quadrature with 40 digits."""
    with mpmath.workdps(40):
        mean, scale, value = (mpmath.mpf(number) for number in (mean, scale, value))
        ends = sorted({value, *(mean + step * scale for step in (-40, -10, -3, 0, 3, 10, 40))})
        total = mpmath.mpf(0)
        for low, high in pairwise(ends):
            above = low >= value
            total += mpmath.quad(
                lambda x, above=above: (mpmath.ncdf((x - mean) / scale) - above) ** 2, [low, high]
            )
        return float(total)


@pytest.mark.parametrize("scale", [1e-6, 0.3, 1.0, 1e8])
@pytest.mark.parametrize("standard", [0.0, 1e-3, -1.0, 4.0, 35.0])
def test_of_a_normal_is_the_integral(scale, standard):
    value = torch.tensor([[0.5 + standard * scale]], dtype=WIDE)
    wanted = by_mpmath(0.5, scale, value.item())
    assert exact(normal([[0.5]], [[scale]]), value).item() == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-6), (WIDE, 1e-13)])
def test_of_a_normal_is_the_closed_form_of_gneiting_and_raftery(dtype, tolerance):
    generator = np.random.default_rng(0)
    mean, value = generator.normal(size=(2, 200, 1))
    scale = np.exp(generator.normal(size=(200, 1)))
    z = (value - mean) / scale  # Gneiting & Raftery 2007, below eq. 21
    wanted = scale * (z * (2 * stats.norm.cdf(z) - 1) + 2 * stats.norm.pdf(z) - 1 / np.sqrt(np.pi))
    found = exact(normal(mean, scale, dtype), torch.tensor(value, dtype=dtype))
    assert found.dtype == WIDE
    np.testing.assert_allclose(found.numpy(), wanted[:, 0], rtol=tolerance, atol=tolerance)


def mixture_integral(weights, mean, scale, value):
    def cdf(x):
        return (weights * stats.norm.cdf((x - mean) / scale)).sum()

    ends = np.unique(np.append(value, (mean[:, None] + scale[:, None] * np.linspace(-9, 9, 13)).ravel()))
    parts = pairwise(ends)
    return sum(
        integrate.quad(lambda x, a=a: (cdf(x) - (a >= value)) ** 2, a, b, epsabs=1e-13)[0] for a, b in parts
    )


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1), st.integers(2, 4), st.floats(-12, 12), st.floats(-3, 1))
def test_of_a_mixture_of_normals_is_the_integral(seed, count, value, log_scale):
    generator = np.random.default_rng(seed)
    weights = generator.dirichlet(np.ones(count))
    mean = generator.normal(size=count) * 3
    scale = 10 ** (log_scale + generator.uniform(-1, 0, count))
    density = Mixture(torch.tensor(weights).log()[None], normal(mean[None, :, None], scale[None, :, None]))
    found = exact(density, torch.tensor([[value]], dtype=WIDE)).item()
    assert found == pytest.approx(mixture_integral(weights, mean, scale, value), rel=1e-9, abs=1e-10)


def test_a_mixture_of_one_is_its_component_to_the_last_bit():
    component = normal(torch.randn(5, 1, 1, dtype=WIDE), torch.rand(5, 1, 1, dtype=WIDE))
    value = torch.randn(5, 1, dtype=WIDE)
    alone = normal(component.base_dist.loc[:, 0], component.base_dist.scale[:, 0])
    assert torch.equal(exact(Mixture(torch.zeros(5, 1), component), value), exact(alone, value))


def test_however_normals_are_wrapped_the_score_is_the_same():
    torch.manual_seed(0)
    mean, scale = torch.randn(4, 3, 1, dtype=WIDE), torch.rand(4, 3, 1, dtype=WIDE) + 0.1
    value, weights = torch.randn(4, 1, dtype=WIDE), torch.randn(4, 3, dtype=WIDE)
    wanted = exact(Mixture(weights, normal(mean, scale)), value)
    apart = Stacked([normal(mean[:, k], scale[:, k]) for k in range(3)])
    folded = Reshaped(normal(mean.flatten(0, 1), scale.flatten(0, 1)), (4, 3))
    joint = MultivariateNormal(mean, scale_tril=scale.unsqueeze(-1))
    nested = Reshaped(Mixture(weights[:, None], Reshaped(apart, (4, 1, 3))), (4,))
    for components in (apart, folded, joint):
        torch.testing.assert_close(exact(Mixture(weights, components), value), wanted, rtol=1e-14, atol=0)
    torch.testing.assert_close(exact(nested, value), wanted, rtol=1e-14, atol=0)


def test_more_components_than_fit_into_the_memory_at_once(monkeypatch):
    monkeypatch.setattr("plugins.metric.crps.score.CHUNK", 100)
    torch.manual_seed(1)
    mean = torch.randn(7, 9, 1, dtype=WIDE)
    density, value = Mixture(torch.zeros(7, 9), normal(mean, mean.abs())), torch.zeros(7, 1, dtype=WIDE)
    weights = np.full(9, 1 / 9)
    for row in range(7):
        flat = mean[row, :, 0].numpy()
        wanted = mixture_integral(weights, flat, np.abs(flat), 0.0)
        assert exact(density, value)[row].item() == pytest.approx(wanted, rel=1e-9)


def test_points_and_impossible_components():
    value = torch.tensor([[2.0], [1.0]], dtype=WIDE)
    point = Independent(
        Normal(torch.ones(2, 1), torch.zeros(2, 1), validate_args=False), 1, validate_args=False
    )
    assert exact(point, value).tolist() == [1.0, 0.0]  # the absolute deviation
    mean = torch.tensor([[[0.0], [math.inf]]], dtype=WIDE).expand(2, 2, 1)
    loose = Independent(Normal(mean, torch.ones(2, 2, 1), validate_args=False), 1, validate_args=False)
    never = Mixture(torch.tensor([[0.0, -math.inf]]).expand(2, 2), loose)
    torch.testing.assert_close(exact(never, value), exact(normal([[0.0], [0.0]], [[1.0], [1.0]]), value))
    assert exact(normal([[0.0]], [[1.0]]), torch.tensor([[math.inf]])).item() == math.inf
    assert exact(normal([[0.0]], [[1.0]]), torch.tensor([[math.nan]])).isnan().all()


def test_the_marginals_of_a_joint_normal():
    torch.manual_seed(2)
    root = torch.randn(3, 2, 2, dtype=WIDE)
    joint = MultivariateNormal(torch.randn(3, 2, dtype=WIDE), root @ root.mT + torch.eye(2, dtype=WIDE))
    for index in range(2):
        alone = normal(joint.loc[:, index, None], joint.covariance_matrix[:, index, index, None].sqrt())
        value = torch.zeros(3, 1, dtype=WIDE)
        torch.testing.assert_close(exact(marginal(joint, index), value), exact(alone, value))


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-6), (WIDE, 1e-13)])
def test_of_a_cardioid_is_the_closed_form(dtype, tolerance):
    # its only moment is m_1 = exp(iμ)/2: the series has one term
    location = torch.linspace(-40, 40, 50, dtype=dtype)[:, None]
    value = torch.linspace(3, -3, 50, dtype=dtype)[:, None]
    apart = (value - location).double()[:, 0]
    wanted = math.pi / 4 - 4 / math.pi * (apart.cos() / 2 - 1 / 8)
    found = exact(Cardioid(location), value)
    torch.testing.assert_close(found, wanted, rtol=0, atol=3 * tolerance if dtype == WIDE else 1e-5)


@pytest.mark.parametrize("concentration", [0.0, 0.5, 3.0, 60.0, 5e3, 6e4])
@pytest.mark.parametrize("apart", [0.0, 0.01, 1.0, math.pi])
def test_of_an_angle_is_the_integral_over_half_circles(concentration, apart):
    """∫₀^π (P(X in the half circle from t) - 1[y in it])² dt, by quadrature in the density's own numbers."""
    density = about_zero(concentration, mean=0.3)
    value = 0.3 + apart
    step, width = 2e-4, min(math.pi, 12 / math.sqrt(max(concentration, 1e-9)))
    angle = 0.3 + np.linspace(-width, width, 2 * int(width / min(step, width / 2000)) + 1)
    log_density = density.log_prob(torch.tensor(angle)[:, None, None])[:, 0].numpy()
    within = integrate.cumulative_simpson(np.exp(log_density), x=angle, initial=0)
    smooth = CubicHermiteSpline(angle, within / within[-1], np.exp(log_density) / within[-1])

    def below(x):  # F on the line, from the antipode of the mean, a turn adding 1
        turns = np.floor((x - 0.3 + math.pi) / (2 * math.pi))
        return turns + smooth(np.clip(x - turns * 2 * math.pi, angle[0], angle[-1]))

    near = 0.3 + np.linspace(-width, width, 60)
    ends = np.unique(np.concatenate([[0, math.pi, value % math.pi], near % math.pi]))
    nodes, weights = np.polynomial.legendre.leggauss(20)
    t = (ends[:-1] + ends[1:])[:, None] / 2 + np.diff(ends)[:, None] / 2 * nodes
    inside = np.remainder(value - t, 2 * math.pi) < math.pi
    square = (below(t + math.pi) - below(t) - inside) ** 2
    wanted = ((square * weights).sum(1) * np.diff(ends) / 2).sum()
    found = exact(density, torch.tensor([[value]], dtype=WIDE)).item()
    assert found == pytest.approx(wanted, rel=1e-7)


def test_of_an_angle_is_the_double_sum_on_a_fine_grid():
    torch.manual_seed(3)
    density = Mixture(torch.randn(1, 3, dtype=WIDE), Cardioid(torch.randn(1, 3, 1, dtype=WIDE) * 3))
    angle = torch.arange(3000, dtype=WIDE) * (2 * math.pi / 3000)
    mass = density.log_prob(angle[:, None, None])[:, 0].exp() * (2 * math.pi / 3000)
    value = torch.tensor([[1.234]], dtype=WIDE)
    to_value = (mass * angular_distance(angle, value[0, 0])).sum()
    between = mass @ angular_distance(angle[:, None], angle) @ mass
    assert exact(density, value).item() == pytest.approx((to_value - between / 2).item(), abs=2e-6)


@pytest.mark.parametrize("dtype", [torch.float32, WIDE])
def test_limits_of_concentration(dtype):
    value = torch.tensor([[2.5]], dtype=dtype)
    assert exact(about_zero(0.0, dtype), value).item() == pytest.approx(math.pi / 4, rel=1e-7)
    for concentration in (1e12, 1e30):
        found = crps(about_zero(concentration, dtype), value, 64)
        assert found.mean.item() == pytest.approx(2.5, abs=1e-5)
        assert found.error.item() < 1e-5


def test_opposite_modes_score_like_the_uniform_density():
    # the angular distance has odd harmonics only: the score is proper, but not strictly
    there_and_back = Mixture(torch.zeros(1, 2), Cardioid(torch.tensor([[[0.0], [math.pi]]])))
    for value in (0.0, 1.0, 2.0):
        found = exact(there_and_back, torch.tensor([[value]])).item()
        assert found == pytest.approx(math.pi / 4, abs=1e-6)


def test_the_truth_scores_best_in_expectation():
    place = torch.linspace(-1, 1, 21, dtype=WIDE)[:, None]
    torch.manual_seed(4)
    drawn = normal([0.0], [1.0]).sample((20_000,))
    mean = torch.stack(
        [crps(normal(place, torch.ones_like(place)), one.expand(21, 1), 16).mean for one in drawn[:2000]]
    ).mean(0)
    assert mean.argmin().item() in (9, 10, 11)


def test_mean_distances_are_those_of_all_pairs():
    torch.manual_seed(5)
    for drawn in (
        torch.randn(50, 4, dtype=WIDE) * 5,
        torch.zeros(50, 4, dtype=WIDE),
        1e9 + torch.rand(50, 4),
    ):
        drawn = drawn.double()
        first, second = torch.triu_indices(50, 50, 1)
        wanted = (drawn[first] - drawn[second]).abs().mean(0)
        torch.testing.assert_close(mean_distance(drawn), wanted, rtol=1e-12, atol=1e-12)
        wanted = angular_distance(drawn[first], drawn[second]).mean(0)
        torch.testing.assert_close(mean_angular_distance(drawn), wanted, rtol=1e-12, atol=1e-6)


def test_the_fair_estimate_is_unbiased_and_tells_its_error():
    torch.manual_seed(6)
    wanted = exact(normal([[0.0]], [[1.0]]), torch.tensor([[0.7]], dtype=WIDE)).item()
    drawn = torch.randn(16, 20_000, dtype=WIDE)  # two draws a part: where an unfair estimate is off by a half
    found = fair_estimate(drawn, torch.full((20_000,), 0.7, dtype=WIDE), circular=False)
    spread = found.mean.std() / 20_000**0.5
    assert abs(found.mean.mean().item() - wanted) < 4 * spread
    assert found.error.square().mean().sqrt().item() == pytest.approx(found.mean.std().item(), rel=0.02)
    angle = about_zero(2.0)
    at = torch.tensor([[0.7]], dtype=WIDE)
    drawn = angle.sample((16, 20_000))[..., 0, 0]
    found = fair_estimate(drawn, at[0].expand(20_000), circular=True)
    assert abs(found.mean.mean() - exact(angle, at)[0]) < 4 * found.mean.std() / 20_000**0.5


def test_a_density_without_a_closed_form_is_drawn_from():
    mixed = MixtureSameFamily(Categorical(torch.ones(1, 2)), normal([[[-1.0], [1.0]]], [[[0.5], [2.0]]]))
    known = Mixture(torch.zeros(1, 2), normal([[[-1.0], [1.0]]], [[[0.5], [2.0]]]))
    value = torch.tensor([[0.4]], dtype=WIDE)
    torch.manual_seed(7)
    found = crps(mixed, value, 4000)
    assert 0 < found.error.item() < 0.05
    assert found.mean.item() == pytest.approx(exact(known, value).item(), abs=4 * found.error.item())


def test_a_narrow_density_beside_a_broad_one_changes_nothing_of_it():
    head = build(
        "density_head", resolve("density_head", "von_mises"), target=Target("angle", ("a",))
    ).double()
    raw = torch.tensor([[3.0, 0, 0], [2e4, 0, 0], [1e7, 0, 0]], dtype=WIDE)
    value = torch.full((3, 1), 0.01, dtype=WIDE)
    seen = circular_moments(head(raw))
    assert seen.resolved.tolist() == [True, True, False]
    torch.manual_seed(8)
    together = crps(head(raw), value, 400)
    alone = crps(head(raw[:1]), value[:1], 400)
    torch.testing.assert_close(together.mean[0], alone.mean[0], rtol=1e-14, atol=0)
    assert together.error.tolist()[:2] == [0.0, 0.0] and together.error[2] > 0
    # all but a point, 0.01 away, σ = 3e-4: |y - μ| - σ/√π
    assert together.mean[2].item() == pytest.approx(0.01 - 1e-7**0.5 / math.pi**0.5, abs=4e-5)


def test_no_item_no_score():
    joint = MultivariateNormal(torch.zeros(0, 1), scale_tril=torch.eye(1), validate_args=False)
    for density in (Cardioid(torch.zeros(0, 1)), joint):
        assert crps(density, torch.zeros(0, 1), 16).mean.shape == (0,)
