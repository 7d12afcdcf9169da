"""Rows of the contract: meshes of one vertex and of four."""

import torch
from torch import Tensor

from framework.target import Target
from framework.testing.rows import MetricRow


def names(vertices: int) -> tuple[str, ...]:
    return tuple(f"{axis}{vertex}" for vertex in range(vertices) for axis in "xyz")


def scales(count: int) -> Tensor:
    return torch.linspace(0.5, 1.5, count)


ROWS = {
    "vertex_error": (
        MetricRow("one vertex", Target("real", names(1)), fields={"scale": scales}),
        MetricRow("four vertices", Target("real", names(4)), fields={"scale": scales}),
    )
}
