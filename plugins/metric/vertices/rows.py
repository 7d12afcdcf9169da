"""Contract-test cases: meshes of one and four vertices, and meshes of five vertices of three people."""

import torch
from torch import Tensor

from framework.target import Target
from framework.testing.rows import MetricRow


def mesh(vertices: int) -> Target:
    """Return a target with the coordinates of `vertices` vertices."""
    return Target("real", tuple(f"{axis}{vertex}" for vertex in range(vertices) for axis in "xyz"))


def scales(count: int) -> Tensor:
    """Return different scales for `count` samples."""
    return torch.linspace(0.5, 1.5, count)


FIELDS = {
    "centre": lambda count: torch.arange(3.0 * count).reshape(count, 3) / 10,
    "scale": scales,
    "subject": lambda count: torch.arange(count) % 3,
}
ROWS = {
    "vertex_error": (
        MetricRow("one vertex", mesh(1), fields={"scale": scales}),
        MetricRow("four vertices", mesh(4), fields={"scale": scales}),
    ),
    "correspondence": (MetricRow("five vertices", mesh(5), fields=FIELDS),),
}
