import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from torch.distributions import HalfNormal, Independent, Normal

from framework.configuration.schema import build, resolve
from framework.distributions.density import Mixture
from framework.errors import ConfigError, UserError
from framework.prediction import Prediction
from framework.target import Target
from framework.testing.metrics import Cardioid
from plugins.metric.pit.functional import cramer_von_mises, kolmogorov_smirnov, transform
from plugins.metric.pit.metric import PIT

ONE = Target("real", ("height",))
ANGLE = Target("angle", ("azimuth",))


def normal(mean, scale):
    return Independent(Normal(mean, scale, validate_args=False), 1, validate_args=False)


def von_mises(raw):
    return build("density_head", resolve("density_head", "von_mises"), target=ANGLE).to(raw.dtype)(raw)


def compute_metric(target, density, value, **config):
    metric = build("metric", resolve("metric", {"name": "pit", **config}), target=target)
    metric.update(Prediction(density, {"target": value}))
    return metric, {name: number.item() for name, number in metric.compute().items()}


@settings(deadline=None, max_examples=80)
@given(st.lists(st.floats(0, 1), min_size=1, max_size=40))
def test_distances_from_uniform_equal_scipys(values):
    sorted_values = torch.tensor(values, dtype=torch.float64)
    wanted = stats.kstest(values, "uniform", method="asymp").statistic
    assert kolmogorov_smirnov(sorted_values).item() == pytest.approx(wanted, abs=1e-12)
    if len(values) > 1:
        wanted = stats.cramervonmises(values, "uniform").statistic / len(values)
        assert cramer_von_mises(sorted_values).item() == pytest.approx(wanted, abs=1e-12)


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-6), (torch.float64, 1e-13)])
def test_the_transform_of_real_numbers_is_the_distribution_function(dtype, tolerance):
    torch.manual_seed(0)
    mean, value = torch.randn(2, 60, 1, dtype=dtype)
    actual = transform(normal(mean, torch.full_like(mean, 0.7)), value, 10)
    wanted = stats.norm.cdf((value - mean).double().numpy()[:, 0], scale=0.7)
    np.testing.assert_allclose(actual.numpy(), wanted, atol=tolerance)


@pytest.mark.parametrize("turns", [0, 3, -1000])
def test_the_transform_of_angles_starts_at_the_antipode(turns):
    place = torch.linspace(-3, 3, 7, dtype=torch.float64)[:, None]
    difference = torch.tensor([-3.1, -2.0, -0.5, 0.0, 0.5, 2.0, 3.1], dtype=torch.float64)[:, None]
    actual = transform(Cardioid(place), place + difference + turns * 2 * math.pi, 10)
    # ∫ (1 + cos)/2π from -π
    wanted = 0.5 + (difference + difference.sin())[:, 0] / (2 * math.pi)
    torch.testing.assert_close(actual, wanted, rtol=0, atol=1e-11)


def test_the_transform_of_the_uniform_density_starts_at_half_a_turn():
    value = torch.tensor([[-3.0], [0.0], [3.0]], dtype=torch.float64)
    actual = transform(von_mises(torch.zeros(3, 3, dtype=torch.float64)), value, 10)
    torch.testing.assert_close(actual, 0.5 + value[:, 0] / (2 * math.pi), rtol=0, atol=1e-9)


def test_narrow_angles_are_exact_if_their_arcs_are_known_else_ranked():
    raw = torch.tensor([[1e8, 0.0, 0.0]], dtype=torch.float64).expand(5, 3)
    standard = torch.tensor([-2.0, -1.0, 0.0, 1.0, 2.0], dtype=torch.float64)
    wanted = stats.norm.cdf(standard.numpy())  # limit of the density for large κ, exact to 1/κ
    value = standard[:, None] * 1e-4
    torch.manual_seed(1)
    np.testing.assert_allclose(transform(von_mises(raw), value, 50).numpy(), wanted, atol=1e-8)
    floored = build(
        "density_head",
        resolve("density_head", {"name": "uniform_floor", "weight": 1e-6, "component": "von_mises"}),
        target=ANGLE,
    ).double()
    actual = transform(floored(raw), value, 4000)
    np.testing.assert_allclose(actual.numpy(), wanted, atol=4 * 0.5 / 4000**0.5)


def test_unknown_densities_are_ranked_among_draws():
    half = Independent(HalfNormal(torch.ones(3, 1, dtype=torch.float64)), 1)
    value = torch.tensor([[0.2], [1.0], [1e9]], dtype=torch.float64)
    torch.manual_seed(2)
    actual = transform(half, value, 8000).numpy()
    np.testing.assert_allclose(actual, stats.halfnorm.cdf([0.2, 1, 1e9]), atol=4 * 0.5 / 8000**0.5)
    assert actual[2] < 1


@pytest.mark.parametrize("target", [Target("real", ("x", "y")), Target("angle", ("x", "y"))])
def test_true_densities_give_uniform_transforms_and_others_do_not(target):
    torch.manual_seed(3)
    place = torch.randn(2000, 2, dtype=torch.float64)
    if target.kind == "real":
        truth, broad = normal(place, torch.ones_like(place)), normal(place, 3 * torch.ones_like(place))
        narrow = normal(place, torch.ones_like(place) / 3)
    else:
        two = build("density_head", resolve("density_head", "von_mises"), target=target).double()
        raws = [torch.cat([k * torch.tensor([[1.0, 0, 0] * 2])] * 2000).double() for k in (4.0, 0.5, 40.0)]
        truth, broad, narrow = (two(raw) for raw in raws)
    value = truth.sample()
    metric, actual = compute_metric(target, truth, value)
    assert actual["pit_ks"] < 1.63 / 4000**0.5  # 99 % quantile for calibrated densities
    assert actual["pit_cvm"] < 0.743 / 4000
    assert actual["pit_mean"] == pytest.approx(0.5, abs=4 * 12**-0.5 / 4000**0.5)
    assert actual["pit_spread"] == pytest.approx(1, abs=0.06)
    assert compute_metric(target, broad, value)[1]["pit_spread"] < 0.6
    assert compute_metric(target, narrow, value)[1]["pit_spread"] > 1.5
    assert compute_metric(target, broad, value)[1]["pit_ks"] > 0.1
    assert (
        metric.figure("", synthetic=False).axes[0].get_title(loc="right") == "4000 numbers, 2 of each target"
    )


def test_a_mixture_of_one_component_has_the_same_transform():
    place, value = torch.randn(2, 9, 1)
    alone = transform(Cardioid(place), value, 10)
    mixed = transform(Mixture(torch.zeros(9, 1), Cardioid(place.unsqueeze(1))), value, 10)
    assert torch.equal(alone, mixed)


def test_the_figure_shows_the_histogram():
    torch.manual_seed(4)
    value = torch.randn(300, 1)
    metric, _ = compute_metric(ONE, normal(torch.zeros(300, 1), torch.ones(300, 1)), value, bins=10)
    figure = metric.figure("one/two", synthetic=True)
    assert figure.get_suptitle() == "one/two (synthetic data)"
    heights = figure.axes[0].patches[-1].get_data().values
    wanted, _ = np.histogram(stats.norm.cdf(value.numpy()), bins=10, range=(0, 1))
    np.testing.assert_allclose(heights, wanted / 30)
    PIT(ONE).figure("nothing seen", synthetic=False)


def test_nan_and_classes_raise_an_error():
    density = normal(torch.tensor([[math.nan], [0.0]]), torch.ones(2, 1))
    with pytest.raises(UserError, match="1 of 2 transforms in this batch are NaN, the first in row 0"):
        compute_metric(ONE, density, torch.zeros(2, 1))
    with pytest.raises(UserError, match="transforms"):
        compute_metric(ANGLE, Cardioid(torch.tensor([[math.nan]])), torch.zeros(1, 1))
    with pytest.raises(ConfigError, match="classes have no order"):
        PIT(Target("class", ("off", "on")))
