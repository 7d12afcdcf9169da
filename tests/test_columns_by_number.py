"""Tests of result tables for targets of several numbers, which may have different units."""

import pytest
import torch
from torch.distributions import Independent, Normal

from framework.configuration.schema import build, resolve
from framework.metric import SINGLE, Metric
from framework.prediction import Prediction
from framework.target import Target

HEADINGS = {"mae": "MAE", "rmse": "RMSE", "crps": "CRPS"}


def compute_in_units(name: str, units: torch.Tensor) -> tuple[Metric, dict[str, float]]:
    """Return a metric of errors of one standard deviation, with the unit of each number given, and its results."""
    target = Target("real", tuple(f"n{index}" for index in range(len(units))))
    metric: Metric = build("metric", resolve("metric", name), target=target)
    ones = torch.ones(5, len(units), dtype=torch.float64)
    density = Independent(Normal(0 * ones, ones * units), 1)
    prediction = Prediction(density, {"target": ones * units})
    prediction.point = 0 * ones  # the mode; of this density, the median would be estimated
    metric.update(prediction)
    return metric, {key: float(value) for key, value in metric.compute().items()}


@pytest.mark.parametrize("count", [1, 2, SINGLE, SINGLE + 1])
@pytest.mark.parametrize("name", HEADINGS)
def test_each_number_has_its_own_column(name: str, count: int) -> None:
    units = 10.0 ** torch.arange(count, dtype=torch.float64).mul(-6)
    metric, results = compute_in_units(name, units)
    single = [f"{name}_n{index}" for index in range(count)] if 1 < count <= SINGLE else []
    assert [*metric.columns] == [name, *single] == [*metric.better]
    expected = compute_in_units(name, torch.ones(1, dtype=torch.float64))[1][name]
    for key, unit in zip(single, units.tolist(), strict=False):
        assert results[key] == pytest.approx(expected * unit, rel=1e-6)
        assert metric.columns[key] == f"{HEADINGS[name]} of {key.removeprefix(f'{name}_')}"
    assert metric.columns[name] == HEADINGS[name] + (", all numbers" if single else "")


def test_angles_have_one_unit_and_one_column() -> None:
    metric: Metric = build("metric", resolve("metric", "crps"), target=Target("angle", ("pan", "tilt")))
    assert metric.columns == {"crps_deg": "CRPS °"}
