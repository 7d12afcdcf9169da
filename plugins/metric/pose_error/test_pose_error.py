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


def head(target, **config):
    config = {"name": "fit_pose", "renderer": FINE, **SIZE, **DOLL, **config}
    return build("density_head", resolve("density_head", config), target=target).eval()


def test_place_errors_against_scipy():
    random = np.random.default_rng(0)
    predicted, true = random.normal(0, 1, (2, 20, 8))
    degrees, centimetres = place_errors(torch.from_numpy(predicted), torch.from_numpy(true))
    between = Rotation.from_rotvec(predicted[:, :3]).inv() * Rotation.from_rotvec(true[:, :3])
    np.testing.assert_allclose(degrees, np.degrees(between.magnitude()), rtol=1e-9)
    np.testing.assert_allclose(centimetres, 100 * np.linalg.norm(predicted[:, 3:6] - true[:, 3:6], axis=1))


def test_the_metric_evaluates_fitted_images(doll_images):
    metric = build("metric", resolve("metric", {"name": "pose_error"}), target=doll_images.target)
    batch = doll_images.splits().test.__getitems__(range(3))
    metric.update(Prediction(head(doll_images.target, steps=1, restarts=0)(batch["input"].flatten(1)), batch))
    results = metric.compute()
    degrees, _ = place_errors(torch.zeros(30), batch["target"][0])
    assert float(degrees) == pytest.approx(30, abs=1e-4)
    assert float(results["rotation_worst_deg"]) >= float(results["rotation_median_deg"])
    assert 0 <= results["found"] <= 1 and len(metric.fitted_images) == 3
    figure = metric.figure("three dolls", synthetic=True)
    assert len(figure.axes) == 15
    metric.reset()
    assert not metric.fitted_images


def test_the_metric_draws_densities_without_a_descent(doll_images):
    metric = build("metric", resolve("metric", {"name": "pose_error"}), target=doll_images.target)
    batch = doll_images.splits().test.__getitems__(range(3))
    narrow = Independent(Normal(batch["target"], torch.full_like(batch["target"], 1e-6)), 1)
    metric.update(Prediction(narrow, batch))
    assert metric.compute()["found"] == 1
    assert len(metric.figure("found", synthetic=True).axes) == 1


def test_a_target_without_rotation_and_translation_raises_an_error():
    with pytest.raises(ConfigError, match="pose_error requires a target that begins with rotation_x"):
        build("metric", resolve("metric", {"name": "pose_error"}), target=Target("real", ("x", "y")))
