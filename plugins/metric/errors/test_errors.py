"""Tests of errors of real numbers, compared with NumPy, and of standard errors, compared with repetitions."""

import numpy as np
import pytest
import torch
from torch.distributions import Independent, Normal

from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.errors.metric import MeanAbsoluteError, RootMeanSquareError

KINDS = {"mae": MeanAbsoluteError, "rmse": RootMeanSquareError}
TARGET = Target("real", ("x", "y"))


def computed(name: str, residual: np.ndarray, location: float = 0.0) -> dict[str, float]:
    metric = KINDS[name](TARGET)
    for part in np.array_split(residual, 3):
        point = torch.full((len(part), 2), location, dtype=torch.float64)
        density = Independent(Normal(point, torch.ones_like(point)), 1)
        prediction = Prediction(density, {"target": point + torch.from_numpy(part)})
        prediction.point = point
        metric.update(prediction)
    return {key: float(value) for key, value in metric.compute().items()}


@pytest.mark.parametrize("location", [0.0, 1e6, -1e12])
@pytest.mark.parametrize("name", KINDS)
def test_errors_equal_numpys(name: str, location: float) -> None:
    residual = np.random.default_rng(0).normal(size=(100, 2)) * [1.0, 1e3]
    residual = (location + residual) - location  # rounded like the sum
    actual = computed(name, residual, location)
    power = {"mae": lambda some: np.abs(some).mean(), "rmse": lambda some: np.sqrt(np.square(some).mean())}[
        name
    ]
    assert actual[name] == pytest.approx(power(residual), rel=1e-12)
    assert actual[f"{name}_x"] == pytest.approx(power(residual[:, 0]), rel=1e-12)
    assert actual[f"{name}_y"] == pytest.approx(power(residual[:, 1]), rel=1e-12)


@pytest.mark.parametrize("name", KINDS)
def test_the_standard_error_is_the_spread_over_repetitions(name: str) -> None:
    random = np.random.default_rng(1)
    runs = [computed(name, random.standard_t(8, size=(400, 2))) for _ in range(300)]
    spread = np.std([run[name] for run in runs])
    # three times the standard deviation of this spread
    assert np.mean([run[f"{name}_sem"] for run in runs]) == pytest.approx(spread, rel=0.13)


def test_perfect_predictions_have_no_standard_error() -> None:
    assert computed("rmse", np.zeros((9, 2))) == dict.fromkeys(
        ["rmse", "rmse_sem", "rmse_x", "rmse_x_sem", "rmse_y", "rmse_y_sem"], 0.0
    )
