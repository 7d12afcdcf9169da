"""Clouds of the generated CAD models of data=modelnet40, for benchmarks."""

from torch import Tensor

from framework.configuration.schema import build, resolve
from framework.geometry.clouds import normalise_clouds


def shapes(points: int, models: int, classes: list[str] | None = None) -> tuple[Tensor, bool]:
    """Return clouds in the unit ball, so many of each class, and whether they are synthetic."""
    config = {
        "name": "modelnet40",
        "points": points,
        "train_models": 2,
        "test_models": models,
        "classes": classes,
    }
    data = build("data", resolve("data", config))
    data.prepare()
    test = data.splits().test
    clouds = test.__getitems__(range(len(test)))["input"]
    return normalise_clouds(clouds, "unit_ball").clouds, data.synthetic
