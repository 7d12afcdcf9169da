import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, optimize, stats
from torch.distributions import Categorical, Independent, MultivariateNormal, Normal, StudentT

from framework.configuration.schema import build, resolve
from framework.distributions.density import Mixture
from framework.errors import DataError, UserError
from framework.prediction import Prediction
from framework.target import Target
from framework.testing.metrics import Cardioid
from plugins.metric.coverage.functional import border, coverage_probability
from plugins.metric.coverage.metric import Coverage

WIDE = torch.float64
ANGLE = Target("angle", ("azimuth",))
CLASSES = Target("class", ("a", "b", "c", "d"))


def normal(mean, scale):
    return Independent(Normal(mean, scale, validate_args=False), 1, validate_args=False)


def head(name, target, **config):
    return build("density_head", resolve("density_head", {"name": name, **config}), target=target).double()


def compute_metric(target, density, value, **config):
    metric = build("metric", resolve("metric", {"name": "coverage", **config}), target=target)
    metric.update(Prediction(density, {"target": value}))
    return metric, {name: number.item() for name, number in metric.compute().items()}


@settings(deadline=None, max_examples=60)
@given(st.lists(st.integers(0, 5), min_size=2, max_size=6).filter(any), st.data())
def test_regions_of_classes_equal_enumeration(counts, data):
    label = data.draw(st.integers(0, len(counts) - 1))
    probability = np.array(counts) / sum(counts)  # with ties and zeros
    density = Categorical(probs=torch.tensor(probability)[None])
    actual = border(density, torch.tensor([label]), 0.9, 10)
    lower = sum(p for p, c in zip(probability, counts, strict=True) if c > counts[label])
    upper = sum(p for p, c in zip(probability, counts, strict=True) if c >= counts[label])
    # torch replaces p = 0 by 2e-16
    assert actual.low.item() == pytest.approx(lower, abs=1e-12)
    assert actual.high.item() == pytest.approx(upper, abs=1e-12)
    size, missing = 0.0, 0.9
    for p in sorted(probability, reverse=True):
        part = min(1.0, max(0.0, missing) / p) if p > 0 else 0.0
        size, missing = size + part, missing - p
    assert actual.size.item() == pytest.approx(size, abs=1e-9)


@pytest.mark.parametrize("logit", [1.0, 30.0, 1e4])
def test_regions_of_labels_from_uncertain_to_certain(logit):
    density = Categorical(logits=torch.tensor([[logit, -logit, -logit]]).log_softmax(-1).expand(2, 3))
    actual = border(density, torch.tensor([0, 1]), 0.9, 10)
    sure = 1 / (1 + 2 * math.exp(-2 * logit))
    np.testing.assert_allclose(actual.low.numpy(), [0, sure], atol=1e-6)
    np.testing.assert_allclose(actual.high.numpy(), [sure, 1], atol=1e-6)
    wanted = 0.9 / sure if sure >= 0.9 else 1 + (0.9 - sure) / ((1 - sure) / 2)
    np.testing.assert_allclose(actual.size.numpy(), wanted, rtol=1e-6)


def test_ties_count_with_their_probability():
    levels = torch.tensor([0.1, 0.5, 0.9], dtype=WIDE)
    low, high = torch.tensor([0.0, 0.4, 0.5, 1.0], dtype=WIDE), torch.tensor([0.2, 0.6, 0.5, 1.0], dtype=WIDE)
    wanted = [[0.5, 1, 1], [0, 0.5, 1], [0, 1, 1], [0, 0, 0]]
    np.testing.assert_allclose(coverage_probability(low, high, levels).numpy(), wanted, atol=1e-12)


@pytest.mark.parametrize("numbers", [1, 2, 5])
def test_regions_of_a_joint_normal_follow_chi_square(numbers):
    torch.manual_seed(0)
    root = torch.randn(40, numbers, numbers, dtype=WIDE).tril(-1) + torch.eye(numbers, dtype=WIDE)
    mean, value = torch.randn(2, 40, numbers, dtype=WIDE)
    actual = border(MultivariateNormal(mean, scale_tril=root), value, 0.9, 10)
    gap = np.linalg.solve(root.numpy(), (value - mean).numpy()[..., None])[..., 0]
    wanted = stats.chi2(numbers).cdf((gap**2).sum(-1))
    np.testing.assert_allclose(actual.low.numpy(), wanted, rtol=1e-10)
    assert torch.equal(actual.low, actual.high)
    if numbers == 1:
        np.testing.assert_allclose(actual.size.numpy(), 2 * stats.norm.ppf(0.95), rtol=1e-10)
    assert numbers == 1 or actual.size.isnan().all()


@pytest.mark.parametrize("dtype", [torch.float32, WIDE])
@pytest.mark.parametrize("concentration", [0.3, 4.0, 300.0, 5e3, 5e4])
def test_the_region_of_one_angle_is_the_arc_around_the_mean(concentration, dtype):
    scale = min(1.0, 1 / math.sqrt(concentration))
    value = torch.tensor([0.0, 0.1, -0.7, 1.5, 2.5], dtype=dtype)[:, None] * scale
    raw = torch.tensor([[concentration, 0.0, 0.0]], dtype=dtype).expand(5, 3)
    actual = border(head("von_mises", ANGLE).to(dtype)(raw), value, 0.9, 10)

    def mass(width):
        def density(x):
            return math.exp(-2 * concentration * math.sin(x / 2) ** 2)

        cuts = [min(c * scale, math.pi) for c in (0, 1, 3, 8, 40)] + [math.pi]
        whole = sum(integrate.quad(density, a, b)[0] for a, b in pairwise(cuts))
        return integrate.quad(density, 0, width, points=[min(scale, width / 2)])[0] / whole

    wanted = [mass(abs(number)) for number in value[:, 0].tolist()]
    middle = ((actual.low + actual.high) / 2).numpy()
    # log p is exact to 1e-6 in float32; near the flat mode, a relative difference of 1e-6 has a mass of 1e-3
    single = dtype == torch.float32
    np.testing.assert_allclose(middle[0], wanted[0], atol=5e-3 if single else 1e-6)
    np.testing.assert_allclose(middle[1:], wanted[1:], atol=1e-4 if single else 1e-6)
    width = optimize.brentq(lambda x: mass(x) - 0.9, 1e-9, math.pi)
    np.testing.assert_allclose(actual.size.numpy(), 2 * width, rtol=1e-5 if single else 1e-6)


def test_closed_forms_of_one_angle_agree_with_the_grid():
    raw = torch.randn(50, 3, dtype=WIDE)
    value = torch.randn(50, 1, dtype=WIDE)
    density = head("von_mises", ANGLE)(raw)
    twice = Mixture(torch.zeros(50, 2, dtype=WIDE), head("von_mises", ANGLE)(raw[:, None].expand(50, 2, 3)))
    for closed, on_grid in zip(border(density, value, 0.9, 10), border(twice, value, 0.9, 10), strict=True):
        torch.testing.assert_close(closed, on_grid, rtol=1e-6, atol=1e-7)


def test_all_targets_are_equally_dense_for_the_uniform_angle():
    actual = border(
        head("von_mises", ANGLE)(torch.zeros(3, 3, dtype=WIDE)), torch.randn(3, 1).double(), 0.9, 10
    )
    np.testing.assert_allclose(actual.low.numpy(), 0, atol=1e-9)
    np.testing.assert_allclose(actual.high.numpy(), 1, atol=1e-9)
    np.testing.assert_allclose(actual.size.numpy(), 0.9 * 2 * math.pi, rtol=1e-9)


def test_regions_of_several_arcs():
    # two modes with masses 0.7 and 0.3; the heavier mode is denser
    raw = torch.tensor([[[200.0, 0, 0], [-200.0, 0, 0]]], dtype=WIDE)
    weights = torch.tensor([[0.7, 0.3]], dtype=WIDE).log()
    density = Mixture(weights, head("von_mises", ANGLE)(raw))
    value = torch.tensor([[math.pi + 0.01]], dtype=WIDE)
    actual = border(density, value, 0.9, 10)
    angle = np.linspace(-np.pi, np.pi, 400_001)[:-1]
    dense = density.log_prob(torch.tensor(angle)[:, None, None])[:, 0].exp().numpy()
    step = angle[1] - angle[0]
    at = density.log_prob(value).exp().item()
    assert actual.low.item() == pytest.approx(dense[dense > at].sum() * step, abs=2e-4)
    order = np.sort(dense)[::-1]
    wanted = (np.cumsum(order) * step < 0.9).sum() * step
    assert actual.size.item() == pytest.approx(wanted, rel=1e-3)


def test_unknown_densities_are_estimated_from_draws():
    torch.manual_seed(1)
    student = Independent(StudentT(torch.full((4, 1), 5.0, dtype=WIDE)), 1)
    value = torch.tensor([[0.0], [0.5], [-1.0], [4.0]], dtype=WIDE)
    actual = border(student, value, 0.9, 20_000)
    wanted = 2 * stats.t(5).cdf(value.abs().numpy()[:, 0]) - 1
    np.testing.assert_allclose(actual.low.numpy(), wanted, atol=4 * 0.5 / 20_000**0.5)
    np.testing.assert_allclose((actual.high - actual.low).numpy()[1:], 1 / 20_001, rtol=1e-9)
    np.testing.assert_allclose(actual.size.numpy(), 2 * stats.t(5).ppf(0.95), rtol=0.03)
    pair = Independent(StudentT(torch.full((4, 2), 5.0)), 1)
    assert border(pair, torch.zeros(4, 2), 0.9, 50).size.isnan().all()


def test_densities_too_narrow_for_the_grid_are_drawn_and_do_not_affect_others():
    raw = torch.tensor([[3.0, 0, 0], [1e9, 0, 0]], dtype=WIDE)
    value = torch.tensor([[0.3], [0.5e-9**0.5 * 2**0.5]], dtype=WIDE)
    torch.manual_seed(2)
    actual = border(head("von_mises", ANGLE)(raw), value, 0.9, 5000)
    alone = border(head("von_mises", ANGLE)(raw[:1]), value[:1], 0.9, 5000)
    torch.testing.assert_close(actual.low[0], alone.low[0], rtol=1e-3, atol=0)
    wanted = 2 * stats.norm.cdf(1) - 1  # the target is one σ away
    assert actual.low[1].item() == pytest.approx(wanted, abs=4 * 0.5 / 5000**0.5)
    assert actual.size[1].item() == pytest.approx(2 * stats.norm.ppf(0.95) * 1e-9**0.5, rel=0.1)


@pytest.mark.parametrize("kind", ["class", "real", "mixture", "angle", "angles", "rotation"])
def test_regions_of_the_true_density_have_the_nominal_coverage(kind):
    torch.manual_seed(3)
    count = 1500
    target = Target("angle", ("azimuth", "elevation", "tilt"))
    if kind == "class":
        target, density = CLASSES, Categorical(logits=torch.randn(count, 4))
    elif kind == "real":
        target, density = Target("real", ("x",)), normal(torch.randn(count, 1), torch.rand(count, 1) + 0.1)
    elif kind == "mixture":
        target = Target("real", ("x",))
        density = Mixture(
            torch.randn(count, 2), normal(3 * torch.randn(count, 2, 1), torch.ones(count, 2, 1))
        )
    elif kind == "angle":
        target, density = ANGLE, head("von_mises", ANGLE)(4 * torch.randn(count, 3, dtype=WIDE))
    elif kind == "angles":
        density = head("von_mises", target)(4 * torch.randn(count, 9, dtype=WIDE))
    else:
        density = head("matrix_fisher", target)(3 * torch.randn(count, 9, dtype=WIDE))
    _, actual = compute_metric(target, density, density.sample(), samples=60)
    for level in (50, 90):
        share = level / 100
        error = (share * (1 - share) / count) ** 0.5
        assert actual[f"coverage_{level}"] == pytest.approx(share, abs=4 * error)
    assert actual["coverage_error"] < 0.025


def test_too_narrow_and_too_broad_densities_are_distinguished():
    torch.manual_seed(4)
    value = torch.randn(800, 1)
    target = Target("real", ("x",))
    zeros, ones = torch.zeros(800, 1), torch.ones(800, 1)
    _, narrow = compute_metric(target, normal(zeros, ones / 3), value)
    _, broad = compute_metric(target, normal(zeros, 3 * ones), value)
    assert narrow["coverage_90"] == pytest.approx(2 * stats.norm.cdf(stats.norm.ppf(0.95) / 3) - 1, abs=0.08)
    assert broad["coverage_50"] == pytest.approx(2 * stats.norm.cdf(stats.norm.ppf(0.75) * 3) - 1, abs=0.08)
    assert broad["region_90"] == pytest.approx(9 * narrow["region_90"], rel=1e-5)
    assert min(narrow["coverage_error"], broad["coverage_error"]) > 0.2


def test_the_figure_shows_shares_against_masses():
    torch.manual_seed(5)
    density = Categorical(logits=torch.randn(200, 4))
    metric, actual = compute_metric(CLASSES, density, density.sample())
    axes = metric.figure("one/two", synthetic=True).axes[0]
    curves = {line.get_label(): line.get_xydata() for line in axes.lines}["targets"]
    assert curves[17].tolist() == pytest.approx([0.9, actual["coverage_90"]])
    Coverage(CLASSES).figure("nothing seen", synthetic=False)


def test_nan_and_wrong_labels_raise_a_clear_message():
    with pytest.raises(UserError, match="1 of 2 masses of regions in this batch are NaN, the first in row 1"):
        compute_metric(
            Target("real", ("x",)),
            normal(torch.tensor([[0.0], [math.nan]]), torch.ones(2, 1)),
            torch.zeros(2, 1),
        )
    with pytest.raises(UserError, match="masses of regions"):
        compute_metric(ANGLE, Cardioid(torch.tensor([[math.nan]])), torch.zeros(1, 1))
    three = Target("angle", ("a", "b", "c"))
    with pytest.raises(UserError, match="masses of regions"):
        compute_metric(three, Cardioid(torch.tensor([[math.nan, 0.0, 0.0]])), torch.zeros(1, 3))
    with pytest.raises(DataError, match="is 4, but class indices go from 0 to 3"):
        compute_metric(CLASSES, Categorical(logits=torch.zeros(1, 4)), torch.tensor([4]))
