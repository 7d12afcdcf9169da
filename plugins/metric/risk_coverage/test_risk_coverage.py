import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.distributions import Categorical, Independent, Normal

from framework.configuration.schema import build, resolve
from framework.errors import UserError
from framework.metric import jackknife_error
from framework.prediction import Prediction
from framework.target import Target
from framework.testing.metrics import Cardioid
from plugins.metric.risk_coverage.functional import (
    area,
    areas_without_each,
    at_coverage,
    curve,
    error_at_coverage,
)
from plugins.metric.risk_coverage.metric import RiskCoverage

WIDE = torch.float64
CLASSES = Target("class", ("a", "b", "c"))
ANGLES = Target("angle", ("azimuth", "tilt"))


def compute_metric(target, density, value, **config):
    metric = build("metric", resolve("metric", {"name": "risk_coverage", **config}), target=target)
    metric.update(Prediction(density, {"target": value}))
    return metric, {name: number.item() for name, number in metric.compute().items()}


@settings(deadline=None, max_examples=60)
@given(st.lists(st.tuples(st.integers(-1, 1), st.integers(0, 4)), min_size=1, max_size=6))
def test_ties_are_averaged_over_every_order(pairs):
    confidence, risk = (np.array(column, dtype=float) for column in zip(*pairs, strict=True))
    curves = [
        np.cumsum(risk[list(order)]) / np.arange(1, len(risk) + 1)
        for order in itertools.permutations(range(len(risk)))
        if (np.diff(confidence[list(order)]) <= 0).all()
    ]
    actual = curve(torch.tensor(confidence), torch.tensor(risk))
    np.testing.assert_allclose(actual.numpy(), np.mean(curves, 0), rtol=1e-12, atol=1e-12)
    assert area(actual).item() == pytest.approx(np.mean(curves), rel=1e-12, abs=1e-12)


@settings(deadline=None, max_examples=150)
@given(st.lists(st.tuples(st.integers(-2, 2), st.floats(0, 4)), min_size=2, max_size=12))
def test_leaving_one_out_equals_the_curve_of_the_others(pairs):
    confidence, risk = (torch.tensor(column, dtype=WIDE) for column in zip(*pairs, strict=True))
    actual = areas_without_each(confidence, risk)
    others = [torch.arange(len(risk)) != number for number in range(len(risk))]
    expected = torch.stack([area(curve(confidence[mask], risk[mask])) for mask in others])
    torch.testing.assert_close(actual, expected, rtol=1e-10, atol=1e-10)


def test_ties_at_the_quantile_count_with_a_share():
    risk = torch.randn(400, generator=torch.Generator().manual_seed(0), dtype=WIDE)
    equal = error_at_coverage(torch.zeros(400), risk, 0.8)
    # the mean over 80 % of ties is, by its definition, that of all
    assert equal == pytest.approx(risk.std().item() / 20, rel=1e-12)


def test_standard_errors_are_those_of_repeated_draws():
    generator = torch.Generator().manual_seed(0)

    def draw():
        confidence = torch.randn(150, generator=generator, dtype=WIDE)
        wrong = torch.rand(150, generator=generator, dtype=WIDE) < torch.sigmoid(-1 - 2 * confidence)
        return confidence, wrong.double()

    names = ("aurc", "e_aurc", "risk_80", "risk_95")
    values = {name: [] for name in (*names, *(f"{name}_sem" for name in names))}
    for _ in range(2000):
        metric = RiskCoverage(CLASSES)
        confidence, risk = draw()
        metric.confidences.append(confidence)
        metric.risks.append(risk)
        metric._update_count = 1
        for name, value in metric.compute().items():
            values[name].append(value.item())
    for name in names:
        tolerance = 0.05 if name == "aurc" else 0.1
        assert np.mean(values[f"{name}_sem"]) == pytest.approx(np.std(values[name]), rel=tolerance), name


def test_errors_of_few_predictions_are_unknown():
    assert jackknife_error(torch.zeros(1)).isnan()
    _, actual = compute_metric(
        CLASSES, Categorical(logits=torch.zeros(1, 3)), torch.zeros(1, dtype=torch.int64)
    )
    assert all(math.isnan(actual[name]) == name.endswith("_sem") for name in actual)


@pytest.mark.parametrize(
    "count, coverage, kept_count",
    [(20, 0.95, 19), (10, 0.8, 8), (3, 0.8, 3), (7, 0.95, 7), (1, 0.8, 1), (100, 0.95, 95)],
)
def test_coverage_is_rounded_up_to_whole_predictions(count, coverage, kept_count):
    assert at_coverage(torch.arange(1.0, count + 1), coverage).item() == kept_count
    assert at_coverage(torch.empty(0), coverage).isnan()


def test_extreme_confidences_keep_their_order():
    confidence = torch.tensor([-math.inf, 1e300, math.inf, -1e300, 0.0, 5e-324], dtype=WIDE)
    risk = torch.tensor([6.0, 2.0, 1.0, 5.0, 4.0, 3.0], dtype=WIDE)
    np.testing.assert_allclose(curve(confidence, risk).numpy(), [1, 1.5, 2, 2.5, 3, 3.5])


@pytest.mark.parametrize("confidence", ["entropy", "mode"])
def test_results_for_classes_equal_a_computation_by_hand(confidence):
    logits = torch.tensor([[4.0, 0, 0], [3.0, 0, 0], [2.0, 0, 0], [1.0, 0, 0], [1e4, -1e4, -1e4]])
    label = torch.tensor([0, 1, 0, 2, 0])
    _, actual = compute_metric(
        CLASSES, Categorical(logits=logits.log_softmax(-1)), label, confidence=confidence
    )
    # errors in order of confidence: 0 0 1 0 1
    own_curve = np.array([0, 0, 1 / 3, 1 / 4, 2 / 5])
    best = np.array([0, 0, 0, 1 / 4, 2 / 5])
    assert actual["aurc"] == pytest.approx(own_curve.mean(), rel=1e-12)
    assert actual["e_aurc"] == pytest.approx((own_curve - best).mean(), rel=1e-12)
    assert actual["risk_80"] == pytest.approx(1 / 4, rel=1e-12)
    assert actual["risk_95"] == pytest.approx(2 / 5, rel=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, WIDE])
def test_results_for_real_numbers_equal_numpy(dtype):
    generator = np.random.default_rng(0)
    scale = np.exp(generator.normal(size=(300, 2)))
    value = scale * generator.normal(size=(300, 2))
    density = Independent(Normal(torch.zeros(300, 2, dtype=dtype), torch.tensor(scale, dtype=dtype)), 1)
    # set the point prediction, because the median of this density would be estimated from draws
    density = Prediction(density, {"target": torch.tensor(value, dtype=dtype)})
    density.point = torch.zeros(300, 2, dtype=dtype)
    metric = RiskCoverage(Target("real", ("x", "y")))
    metric.update(density)
    actual = metric.compute()
    order = np.argsort(np.log(scale).sum(1))
    risk = np.abs(value).mean(1)
    own_curve, best = (np.cumsum(r) / np.arange(1, 301) for r in (risk[order], np.sort(risk)))
    tolerance = 1e-6 if dtype == torch.float32 else 1e-12
    assert actual["aurc"].item() == pytest.approx(own_curve.mean(), rel=tolerance)
    assert actual["e_aurc"].item() == pytest.approx(own_curve.mean() - best.mean(), rel=10 * tolerance)
    assert actual["risk_80"].item() == pytest.approx(own_curve[239], rel=tolerance)
    assert own_curve[239] < risk.mean()


def test_angles_are_reported_in_degrees_and_ties_are_averaged():
    place = torch.zeros(4, 2, dtype=WIDE)
    difference = torch.tensor([[0.1, 0.3], [-0.2, 2 * math.pi], [math.pi, math.pi], [0.0, 0.0]], dtype=WIDE)
    metric, actual = compute_metric(ANGLES, Cardioid(place), place + difference)
    mean = math.degrees((0.2 + 0.1 + math.pi + 0) / 4)
    assert actual["aurc_deg"] == pytest.approx(mean)
    assert actual["risk_80_deg"] == pytest.approx(mean)
    assert metric.columns == {"aurc_deg": "AURC °", "risk_80_deg": "risk at 80 % °"}
    assert set(metric.better) == set(metric.columns)


def test_perfect_confidence_has_no_excess_area():
    logits = torch.tensor([[5.0, 0, 0]] * 7 + [[1.0, 0, 0]] * 3)
    _, actual = compute_metric(CLASSES, Categorical(logits=logits), torch.tensor([0] * 7 + [1] * 3))
    assert actual["e_aurc"] == pytest.approx(0, abs=1e-15)
    assert actual["aurc"] == pytest.approx((1 / 8 + 2 / 9 + 3 / 10) / 10)
    _, all_wrong = compute_metric(CLASSES, Categorical(logits=logits), torch.ones(10, dtype=torch.int64))
    assert (all_wrong["aurc"], all_wrong["e_aurc"]) == (1.0, 0.0)


def test_the_figure_shows_own_oracle_and_random_order():
    torch.manual_seed(0)
    density = Categorical(logits=torch.randn(50, 3))
    metric, actual = compute_metric(CLASSES, density, density.sample())
    axes = metric.figure("one/two", synthetic=True).axes[0]
    own, oracle, random = axes.lines
    assert np.mean(own.get_ydata()) == pytest.approx(actual["aurc"])
    assert np.mean(own.get_ydata() - oracle.get_ydata()) == pytest.approx(actual["e_aurc"])
    assert random.get_ydata()[0] == own.get_ydata()[-1] == oracle.get_ydata()[-1]
    RiskCoverage(CLASSES).figure("nothing seen", synthetic=False)


def test_nan_raises_a_clear_message():
    with pytest.raises(UserError, match="1 of 1 errors in this batch are NaN"):
        compute_metric(ANGLES, Cardioid(torch.tensor([[math.nan, 0.0]])), torch.zeros(1, 2))
    density = Categorical(logits=torch.tensor([[0.0, 0.0, 0.0], [math.nan, 0.0, 0.0]]), validate_args=False)
    with pytest.raises(UserError, match="1 of 2 confidences in this batch are NaN, the first in row 1"):
        compute_metric(CLASSES, density, torch.zeros(2, dtype=torch.int64))
