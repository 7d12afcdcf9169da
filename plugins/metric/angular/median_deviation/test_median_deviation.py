import numpy as np
import pytest
import torch

from framework.errors import ConfigError
from framework.prediction import Prediction
from framework.target import Target
from framework.testing.metrics import Cardioid
from plugins.metric.angular.median_deviation.metric import MedianAngularDeviation


@pytest.mark.parametrize("count", [1, 2, 7, 100])
@pytest.mark.parametrize("angles", [1, 3])
def test_agrees_with_numpy(count, angles):
    metric = MedianAngularDeviation(Target("angle", ("a", "b", "c")[:angles]))
    predicted, true = 9 * torch.randn(count, angles), 9 * torch.randn(count, angles)
    for part in torch.arange(count).split(4):
        metric.update(Prediction(Cardioid(predicted[part]), {"target": true[part]}))
    gap = (predicted - true).double().numpy()
    wanted = np.median(np.degrees(np.abs(np.arctan2(np.sin(gap), np.cos(gap)))).mean(-1))
    assert metric.compute()["median_deviation_deg"].item() == pytest.approx(wanted, abs=1e-4)


def test_targets_without_angles_are_refused():
    with pytest.raises(ConfigError, match="median_deviation describes targets of kind 'angle'"):
        MedianAngularDeviation(Target("real", ("x",)))
