"""Contract-test cases: uniform floors with densities over angles and over classes."""

import math
from collections.abc import Iterator

import torch

from framework.density_head import DensityHead
from framework.target import Target
from framework.testing.rows import Case, HeadRow

ONE = Target("angle", ("azimuth",))
THREE = Target("angle", ("azimuth", "elevation", "tilt"))
CLASSES = Target("class", ("a", "b", "c"))


def outlier_cases(head: DensityHead) -> Iterator[Case]:
    """Yield a case 3 rad from the mean of a density with κ = 1e6, where only the floor remains: log γ - log 2π."""
    raw = torch.tensor([[1e6, 0.0, 0.0]], dtype=torch.float64)
    value = torch.tensor([[3.0]], dtype=torch.float64)
    log_prob = torch.tensor([math.log(0.125 / (2 * math.pi))], dtype=torch.float64)
    yield Case("κ = 1e6, 3 rad off", raw, value, log_prob)


FLOOR = {"tempered: power": "only the component is raised to the power; the floor stays"}
ROWS = {
    "uniform_floor": (
        HeadRow("one angle", ONE, {"weight": 0.125}, cases=outlier_cases, leave_out=FLOOR),
        HeadRow("three angles", THREE, {"weight": 0.01}, leave_out=FLOOR),
        HeadRow(
            "rotations",
            THREE,
            {"weight": 0.5, "component": {"name": "matrix_fisher"}},
            leave_out={
                "mode": "matrix_fisher's mode is the likeliest rotation, not the likeliest angles",
                **FLOOR,
            },
        ),
        HeadRow("classes", CLASSES, {"weight": 0.01, "component": {"name": "categorical"}}),
        HeadRow("no floor", ONE, {"weight": 0.0}),
    )
}
