"""Point clouds of the generated CAD models of data=modelnet40, for benchmarks."""

from torch import Tensor

from framework.configuration.schema import build, resolve
from framework.geometry.clouds import normalise_clouds


def shapes(points: int, models: int, classes: list[str] | None = None) -> tuple[Tensor, bool]:
    """Return clouds in the unit ball, (cloud, points, 3), and whether they are synthetic.

    Args:
        points: points of a cloud.
        models: number of clouds of each class.
        classes: names of the classes; None: all.
    """
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
