import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch.distributions import Categorical, MultivariateNormal

from framework.configuration.schema import build, resolve
from framework.errors import UserError
from framework.prediction import Prediction
from framework.target import Target
from framework.testing import metrics
from framework.testing.finding import require
from framework.testing.plain import LENGTH, Plain
from framework.testing.rows import MetricRow

CLASSES, ANGLE, REAL = Target("class", ("a", "b", "c")), Target("angle", ("azimuth",)), Target("real", ("x",))

conformal = build(
    "uncertainty", resolve("uncertainty", "conformal"), model=lambda: Plain(CLASSES), target=CLASSES
)
PredictionSet = type(conformal(torch.zeros(1, LENGTH)))
"""Class of the densities with prediction sets that a conformal wrapper returns, as in a run."""


def metric(target):
    return build("metric", resolve("metric", "prediction_set"), target=target)


def evaluate(target, density, threshold, labels, score="density", **fields):
    actual = metric(target)
    sets = PredictionSet(density, torch.tensor(threshold, dtype=torch.float64), score)
    actual.update(Prediction(sets, {"target": labels, **fields}))
    return {name: value.item() for name, value in actual.compute().items()}


@pytest.mark.parametrize(
    "target",
    [CLASSES, *(pytest.param(target, marks=pytest.mark.slow) for target in (ANGLE, REAL))],
    ids=lambda target: target.kind,
)
def test_the_contract_tests_pass_on_sets(target, monkeypatch):
    """Check sets of level 1.7 nats for every density, so that sizes differ between densities."""
    plain = metrics.simplest_density

    def with_sets(target, place, *more):
        return PredictionSet(plain(target, place, *more), torch.tensor(1.7, dtype=torch.float64), "density")

    monkeypatch.setattr(metrics, "simplest_density", with_sets)
    # equal densities have sets of equal size, whether the prediction is right or not
    equal = {"perfect beats random": "sizes do not depend on the target"}
    require(*metrics.examine_metric(MetricRow("sets", target, leave_out=equal), lambda: metric(target)))


def test_sets_of_classes_equal_a_loop():
    torch.manual_seed(0)
    density = Categorical(logits=2 * torch.randn(200, 3).double(), validate_args=False)
    label = torch.randint(3, (200,))
    actual = evaluate(CLASSES, density, 0.7, label)
    covered_count = size = empty = 0
    for row, true in zip(density.probs.tolist(), label.tolist(), strict=True):
        labels_in_set = [index for index, share in enumerate(row) if -math.log(share) <= 0.7]
        covered_count, size, empty = (
            covered_count + (true in labels_in_set),
            size + len(labels_in_set),
            empty + (not labels_in_set),
        )
    assert actual["set_coverage"] == covered_count / 200 and actual["set_size"] == size / 200
    assert actual["set_empty"] == empty / 200 and empty > 0
    wanted = np.std(np.r_[np.ones(covered_count), np.zeros(200 - covered_count)], ddof=1) / 200**0.5
    assert actual["set_coverage_sem"] == pytest.approx(wanted)


def test_sets_of_one_angle_and_of_one_real_number():
    kind = type(build("density_head", resolve("density_head", "von_mises"), target=ANGLE)(torch.zeros(1, 3)))
    density = kind(torch.zeros(2, 1).double(), torch.tensor([[4.0], [900.0]]).double())
    actual = evaluate(ANGLE, density, math.log(10), torch.tensor([[0.01], [1.0]]).double(), "mass")
    arcs = [math.degrees(2 * stats.vonmises.ppf(0.95, kappa)) for kappa in (4, 900)]
    assert actual["set_size_deg"] == pytest.approx(np.mean(arcs), rel=2e-3) and actual["set_coverage"] == 0.5
    assert "set_size" not in actual and metric(ANGLE).columns["set_size_deg"] == "set size °"
    normal = MultivariateNormal(torch.zeros(3, 1).double(), torch.eye(1).double(), validate_args=False)
    level = 0.5 * math.log(2 * math.pi) + 2.0  # log p is 2 nats below its maximum at ±2
    actual = evaluate(REAL, normal, level, torch.tensor([[1.9], [-1.9], [2.1]]).double())
    assert actual["set_size"] == pytest.approx(4) and actual["set_coverage"] == pytest.approx(2 / 3)
    everything = evaluate(REAL, normal, math.inf, torch.zeros(3, 1).double())
    assert everything["set_size"] == math.inf and everything["set_coverage"] == 1


def test_sets_of_several_numbers():
    plane = Target("real", ("x", "y"))
    normal = MultivariateNormal(torch.zeros(50, 2).double(), torch.eye(2).double(), validate_args=False)
    torch.manual_seed(1)
    actual = evaluate(plane, normal, math.log(2 * math.pi) + 1.0, torch.zeros(50, 2).double())
    assert actual["set_size"] == pytest.approx(2 * math.pi, rel=0.03)  # area of a circle of radius √2
    assert actual["set_coverage"] == 1 and actual["set_empty"] == 0


def test_densities_without_sets_and_nan_raise_a_clear_message():
    density = Categorical(logits=torch.zeros(2, 3), validate_args=False)
    with pytest.raises(
        UserError, match=r"predicts a Categorical, which has none\. Add conformal as the last"
    ):
        metric(CLASSES).update(Prediction(density, {"target": torch.zeros(2, dtype=torch.int64)}))
    broken = Categorical(logits=torch.tensor([[0.0, 1, 2], [math.nan] * 3]), validate_args=False)
    with pytest.raises(UserError, match=r"densities of samples \[41\] are NaN"):
        label, index = torch.zeros(2, dtype=torch.int64), torch.tensor([40, 41])
        evaluate(CLASSES, broken, 1.0, label, index=index)
