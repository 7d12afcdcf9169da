import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from framework.prediction import Prediction
from framework.target import Target
from framework.testing.metrics import Cardioid
from plugins.metric.viewpoint.metric import Viewpoint

TARGET = Target("angle", ("azimuth", "elevation", "tilt"))


def prediction(point, target, dtype=torch.float64):
    return Prediction(
        Cardioid(torch.as_tensor(point, dtype=dtype)), {"target": torch.as_tensor(target, dtype=dtype)}
    )


def compute_metric(point, target, dtype=torch.float64):
    metric = Viewpoint(TARGET)
    metric.update(prediction(point, target, dtype))
    return {name: value.item() for name, value in metric.compute().items()}


def scipy_distance(point, target):
    """Return the angle of R₁⁻¹R₂ in radians, from unit quaternions, of rotations Rz(t) Rx(e - π/2) Rz(-a)."""

    def rotations(angles):
        azimuth, elevation, tilt = np.asarray(angles, dtype=np.float64).T
        return Rotation.from_euler("ZXZ", np.stack([tilt, elevation - math.pi / 2, -azimuth], -1))

    return (rotations(point).inv() * rotations(target)).magnitude()


angle = st.floats(-7, 7, allow_subnormal=False)
viewpoints = st.tuples(angle, angle, angle)


@settings(deadline=None, max_examples=200)
@given(viewpoints, viewpoints)
def test_the_error_equals_scipys_angle(point, target):
    expected = math.degrees(scipy_distance([point], [target])[0])
    assert compute_metric([point], [target])["mederr_deg"] == pytest.approx(expected, abs=math.degrees(1e-6))


@pytest.mark.parametrize("gap", [0.0, 1e-12, 1e-8, 1e-5, 0.1])
@pytest.mark.parametrize("about", [0.0, math.pi])
def test_error_is_right_to_1e_6_radians_near_0_and_a_half_turn(gap, about):
    generator = np.random.default_rng(2)
    for target in generator.uniform(-math.pi, math.pi, (20, 3)):
        # a change of the azimuth rotates the object around its own axis by the same angle
        point = target + np.array([about - gap, 0, 0])
        actual = math.radians(compute_metric(point[None], target[None])["mederr_deg"])
        assert actual == pytest.approx(abs(about - gap), abs=1e-6)
        assert actual == pytest.approx(scipy_distance([point], [target])[0], abs=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [1, 2, 101, 200])
def test_accuracy_and_median_equal_numpys(dtype, count):
    generator = np.random.default_rng(count)
    target = generator.uniform(-math.pi, math.pi, (count, 3)).astype(str(dtype).removeprefix("torch."))
    point = target + generator.normal(0, 0.4, (count, 3)).astype(target.dtype)
    metric = build("metric", resolve("metric", "viewpoint"), target=TARGET)
    metric.update(prediction(point, target, dtype))
    actual = metric.compute()
    errors = scipy_distance(point, target)
    assert actual["acc_pi_6"].item() == np.mean(errors < math.pi / 6)
    assert actual["mederr_deg"].item() == pytest.approx(math.degrees(np.median(errors)), abs=1e-6)


def test_the_order_of_the_angles_does_not_matter():
    generator = np.random.default_rng(3)
    point, target = generator.uniform(-3, 3, (2, 9, 3))
    swapped = Viewpoint(Target("angle", ("tilt", "azimuth", "elevation")))
    swapped.update(prediction(point[:, [2, 0, 1]], target[:, [2, 0, 1]]))
    assert swapped.compute()["mederr_deg"].item() == compute_metric(point, target)["mederr_deg"]


def test_a_nan_prediction_gives_nan():
    actual = compute_metric([[np.nan, 0, 0], [0, 0, 0], [0, 0, 0]], np.zeros((3, 3)))
    assert np.isnan(actual["mederr_deg"])
    assert actual["acc_pi_6"] == pytest.approx(2 / 3)


@pytest.mark.parametrize(
    "target",
    [
        Target("angle", ("azimuth",)),
        Target("angle", ("pan", "tilt", "roll")),
        Target("real", ("azimuth", "elevation", "tilt")),
    ],
)
def test_other_targets_than_the_three_angles_raise_an_error(target):
    with pytest.raises(ConfigError, match="three angles azimuth, elevation, tilt"):
        Viewpoint(target)
