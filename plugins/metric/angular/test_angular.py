import math

import numpy as np
import pytest
import torch
from scipy.stats import sem

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from framework.prediction import Prediction
from framework.target import Target
from framework.testing.metrics import Cardioid
from plugins.metric.angular.metric import MeanAngularDeviation, MedianAngularDeviation

ONE = Target("angle", ("azimuth",))
THREE = Target("angle", ("azimuth", "elevation", "tilt"))


def prediction(point, target, dtype=torch.float64):
    return Prediction(
        Cardioid(torch.as_tensor(point, dtype=dtype)), {"target": torch.as_tensor(target, dtype=dtype)}
    )


def compute_metric(target, *batches, dtype=torch.float64):
    metric = MeanAngularDeviation(target)
    for point, true in batches:
        metric.update(prediction(point, true, dtype))
    return {name: value.item() for name, value in metric.compute().items()}


def loop(point, target):
    """Return angular deviations in degrees, at most 180, one number at a time."""
    rows = []
    for predicted, true in zip(point, target, strict=True):
        row = []
        for a, b in zip(predicted, true, strict=True):
            way = math.degrees(math.fmod(abs(float(a) - float(b)), 2 * math.pi))
            row.append(min(way, 360 - way))
        rows.append(row)
    return np.array(rows)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_results_agree_with_a_loop(dtype):
    generator = np.random.default_rng(0)
    point, target = generator.uniform(-9, 9, (2, 150, 3)).astype(str(dtype).removeprefix("torch."))
    metric = build("metric", resolve("metric", "angular_deviation"), target=THREE)
    metric.update(prediction(point, target, dtype))
    actual = metric.compute()
    expected = loop(point, target)
    assert actual["maad_deg"].item() == pytest.approx(expected.mean(), abs=1e-9)
    assert actual["maad_deg_sem"].item() == pytest.approx(sem(expected.mean(1)), abs=1e-9)
    for index, name in enumerate(THREE.names):
        assert actual[f"maad_{name}_deg"].item() == pytest.approx(expected[:, index].mean(), abs=1e-9)
        assert actual[f"maad_{name}_deg_sem"].item() == pytest.approx(sem(expected[:, index]), abs=1e-9)


@pytest.mark.parametrize(
    "point, target, deviation",
    [
        (math.radians(359), math.radians(1), 2),
        (math.radians(1), math.radians(359), 2),
        (math.radians(179), math.radians(-179), 2),
        (0.0, math.pi, 180),
        (math.radians(90) + 2e5 * math.pi, 0.0, 90),
        (1.0, 1.0, 0),
    ],
)
def test_the_deviation_is_the_shorter_way_around_the_circle(point, target, deviation):
    actual = compute_metric(ONE, ([[point]], [[target]]))
    assert actual["maad_deg"] == pytest.approx(deviation, abs=1e-7)
    assert actual["maad_azimuth_deg"] == actual["maad_deg"]


def test_no_samples_give_nan_and_one_sample_has_no_standard_error():
    empty = compute_metric(ONE, (np.zeros((0, 1)), np.zeros((0, 1))))
    assert all(np.isnan(value) for value in empty.values())
    single_sample = compute_metric(ONE, ([[0.5]], [[0.0]]))
    assert single_sample["maad_deg"] == pytest.approx(math.degrees(0.5))
    assert np.isnan(single_sample["maad_deg_sem"])


def test_equal_deviations_have_no_standard_error():
    assert compute_metric(ONE, (np.full((50, 1), 0.1), np.zeros((50, 1))))["maad_deg_sem"] == pytest.approx(
        0, abs=1e-6
    )


@pytest.mark.parametrize("count", [1, 2, 7, 100])
@pytest.mark.parametrize("angles", [1, 3])
def test_the_median_agrees_with_numpy(count, angles):
    metric = MedianAngularDeviation(Target("angle", ("a", "b", "c")[:angles]))
    predicted, true = 9 * torch.randn(count, angles), 9 * torch.randn(count, angles)
    for part in torch.arange(count).split(4):
        metric.update(Prediction(Cardioid(predicted[part]), {"target": true[part]}))
    gap = (predicted - true).double().numpy()
    wanted = np.median(np.degrees(np.abs(np.arctan2(np.sin(gap), np.cos(gap)))).mean(-1))
    assert metric.compute()["median_deviation_deg"].item() == pytest.approx(wanted, abs=1e-4)


@pytest.mark.parametrize(
    "kind, name", [(MeanAngularDeviation, "angular_deviation"), (MedianAngularDeviation, "median_deviation")]
)
def test_targets_that_are_not_angles_raise_an_error(kind, name):
    with pytest.raises(ConfigError, match=f"{name} describes targets of kind 'angle'"):
        kind(Target("real", ("x",)))
