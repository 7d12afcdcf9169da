import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.distributions import Independent, Normal

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from framework.prediction import Prediction
from framework.target import Target
from framework.testing.bodies import DOLL
from plugins.metric.pose_error.errors import place_errors

SIZE = {"height": 48, "width": 40}
FINE = {"name": "rasterizer", "supersampling": 4}


@pytest.fixture(scope="module")
def data():
    config = {
        "name": "pose_from_image",
        "renderer": FINE,
        "train": 3,
        "validation": 2,
        "test": 6,
        **SIZE,
        **DOLL,
    }
    found = build("data", resolve("data", config))
    found.prepare()
    return found


def head(target, **config):
    config = {"name": "fit_pose", "renderer": FINE, **SIZE, **DOLL, **config}
    return build("density_head", resolve("density_head", config), target=target).eval()


def test_place_errors_against_scipy():
    random = np.random.default_rng(0)
    one, other = random.normal(0, 1, (2, 20, 8))
    degrees, centimetres = place_errors(torch.from_numpy(one), torch.from_numpy(other))
    between = Rotation.from_rotvec(one[:, :3]).inv() * Rotation.from_rotvec(other[:, :3])
    np.testing.assert_allclose(degrees, np.degrees(between.magnitude()), rtol=1e-9)
    np.testing.assert_allclose(centimetres, 100 * np.linalg.norm(one[:, 3:6] - other[:, 3:6], axis=1))


def test_the_metric_sees_what_arrived(data):
    metric = build("metric", resolve("metric", {"name": "pose_error"}), target=data.target)
    batch = data.splits().test.__getitems__(range(3))
    metric.update(Prediction(head(data.target, steps=1, restarts=0)(batch["input"].flatten(1)), batch))
    found = metric.compute()
    degrees, _ = place_errors(torch.zeros(30), batch["target"][0])
    assert float(degrees) == pytest.approx(30, abs=1e-4)
    assert float(found["rotation_worst_deg"]) >= float(found["rotation_median_deg"])
    assert 0 <= found["found"] <= 1 and len(metric.shown) == 3
    figure = metric.figure("three dolls", synthetic=True)
    assert len(figure.axes) == 15
    metric.reset()
    assert not metric.shown


def test_the_metric_draws_densities_that_do_not_say_how_they_were_found(data):
    metric = build("metric", resolve("metric", {"name": "pose_error"}), target=data.target)
    batch = data.splits().test.__getitems__(range(3))
    there = Independent(Normal(batch["target"], torch.full_like(batch["target"], 1e-6)), 1)
    metric.update(Prediction(there, batch))
    assert metric.compute()["found"] == 1
    assert len(metric.figure("found", synthetic=True).axes) == 1


def test_a_target_without_rotation_and_translation_is_refused():
    with pytest.raises(ConfigError, match="pose_error reads rotation_x"):
        build("metric", resolve("metric", {"name": "pose_error"}), target=Target("real", ("x", "y")))
