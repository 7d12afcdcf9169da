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
from framework.prediction import Prediction
from framework.target import Target
from framework.testing.metrics import Cardioid
from plugins.metric.risk_coverage.functional import area, at_coverage, curve
from plugins.metric.risk_coverage.metric import RiskCoverage

WIDE = torch.float64
CLASSES = Target("class", ("a", "b", "c"))
ANGLES = Target("angle", ("azimuth", "tilt"))


def measured(target, density, value, **config):
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
    found = curve(torch.tensor(confidence), torch.tensor(risk))
    np.testing.assert_allclose(found.numpy(), np.mean(curves, 0), rtol=1e-12, atol=1e-12)
    assert area(found).item() == pytest.approx(np.mean(curves), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize(
    "count, coverage, kept",
    [(20, 0.95, 19), (10, 0.8, 8), (3, 0.8, 3), (7, 0.95, 7), (1, 0.8, 1), (100, 0.95, 95)],
)
def test_the_fewest_that_are_such_a_share(count, coverage, kept):
    assert at_coverage(torch.arange(1.0, count + 1), coverage).item() == kept
    assert at_coverage(torch.empty(0), coverage).isnan()


def test_extreme_confidences_keep_their_order():
    confidence = torch.tensor([-math.inf, 1e300, math.inf, -1e300, 0.0, 5e-324], dtype=WIDE)
    risk = torch.tensor([6.0, 2.0, 1.0, 5.0, 4.0, 3.0], dtype=WIDE)
    np.testing.assert_allclose(curve(confidence, risk).numpy(), [1, 1.5, 2, 2.5, 3, 3.5])


@pytest.mark.parametrize("confidence", ["entropy", "mode"])
def test_classes_by_hand(confidence):
    logits = torch.tensor([[4.0, 0, 0], [3.0, 0, 0], [2.0, 0, 0], [1.0, 0, 0], [1e4, -1e4, -1e4]])
    label = torch.tensor([0, 1, 0, 2, 0])
    _, found = measured(CLASSES, Categorical(logits=logits.log_softmax(-1)), label, confidence=confidence)
    # errors in order of confidence: 0 0 1 0 1
    kept = np.array([0, 0, 1 / 3, 1 / 4, 2 / 5])
    best = np.array([0, 0, 0, 1 / 4, 2 / 5])
    assert found["aurc"] == pytest.approx(kept.mean(), rel=1e-12)
    assert found["e_aurc"] == pytest.approx((kept - best).mean(), rel=1e-12)
    assert found["risk_80"] == pytest.approx(1 / 4, rel=1e-12)
    assert found["risk_95"] == pytest.approx(2 / 5, rel=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, WIDE])
def test_reals_by_their_spread(dtype):
    generator = np.random.default_rng(0)
    scale = np.exp(generator.normal(size=(300, 2)))
    value = scale * generator.normal(size=(300, 2))
    density = Independent(Normal(torch.zeros(300, 2, dtype=dtype), torch.tensor(scale, dtype=dtype)), 1)
    # the median of a density that has not told it is drawn: here it is told
    density = Prediction(density, {"target": torch.tensor(value, dtype=dtype)})
    density.point = torch.zeros(300, 2, dtype=dtype)
    metric = RiskCoverage(Target("real", ("x", "y")))
    metric.update(density)
    found = metric.compute()
    order = np.argsort(np.log(scale).sum(1))
    risk = np.abs(value).mean(1)
    kept, best = (np.cumsum(r) / np.arange(1, 301) for r in (risk[order], np.sort(risk)))
    tolerance = 1e-6 if dtype == torch.float32 else 1e-12
    assert found["aurc"].item() == pytest.approx(kept.mean(), rel=tolerance)
    assert found["e_aurc"].item() == pytest.approx(kept.mean() - best.mean(), rel=10 * tolerance)
    assert found["risk_80"].item() == pytest.approx(kept[239], rel=tolerance)
    assert kept[239] < risk.mean()


def test_angles_are_told_in_degrees_and_equal_confidence_is_a_random_order():
    place = torch.zeros(4, 2, dtype=WIDE)
    apart = torch.tensor([[0.1, 0.3], [-0.2, 2 * math.pi], [math.pi, math.pi], [0.0, 0.0]], dtype=WIDE)
    metric, found = measured(ANGLES, Cardioid(place), place + apart)
    mean = math.degrees((0.2 + 0.1 + math.pi + 0) / 4)
    assert found["aurc_deg"] == pytest.approx(mean)
    assert found["risk_80_deg"] == pytest.approx(mean)
    assert metric.columns == {"aurc_deg": "AURC °", "risk_80_deg": "risk at 80 % °"}
    assert set(metric.better) == set(metric.columns)


def test_perfect_confidence_leaves_nothing_to_save():
    logits = torch.tensor([[5.0, 0, 0]] * 7 + [[1.0, 0, 0]] * 3)
    _, found = measured(CLASSES, Categorical(logits=logits), torch.tensor([0] * 7 + [1] * 3))
    assert found["e_aurc"] == pytest.approx(0, abs=1e-15)
    assert found["aurc"] == pytest.approx((1 / 8 + 2 / 9 + 3 / 10) / 10)
    _, all_wrong = measured(CLASSES, Categorical(logits=logits), torch.ones(10, dtype=torch.int64))
    assert (all_wrong["aurc"], all_wrong["e_aurc"]) == (1.0, 0.0)


def test_the_picture_shows_own_oracle_and_random_order():
    torch.manual_seed(0)
    density = Categorical(logits=torch.randn(50, 3))
    metric, found = measured(CLASSES, density, density.sample())
    axes = metric.figure("one/two", synthetic=True).axes[0]
    own, oracle, random = axes.lines
    assert np.mean(own.get_ydata()) == pytest.approx(found["aurc"])
    assert np.mean(own.get_ydata() - oracle.get_ydata()) == pytest.approx(found["e_aurc"])
    assert random.get_ydata()[0] == own.get_ydata()[-1] == oracle.get_ydata()[-1]
    RiskCoverage(CLASSES).figure("nothing seen", synthetic=False)


def test_nan_is_named():
    with pytest.raises(UserError, match="1 of 1 errors in this batch are NaN"):
        measured(ANGLES, Cardioid(torch.tensor([[math.nan, 0.0]])), torch.zeros(1, 2))
    density = Categorical(logits=torch.tensor([[0.0, 0.0, 0.0], [math.nan, 0.0, 0.0]]), validate_args=False)
    with pytest.raises(UserError, match="1 of 2 confidences in this batch are NaN, the first in row 1"):
        measured(CLASSES, density, torch.zeros(2, dtype=torch.int64))
