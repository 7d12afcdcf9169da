"""Contract-test cases: objects with a finite, a continuous and no symmetry, with and without an optimum."""

from collections.abc import Mapping

import torch
from torch import Tensor

from framework.target import Target
from framework.testing.finding import SEED
from framework.testing.rows import MetricRow

TARGET = Target("angle", ("azimuth", "elevation", "tilt"))


def rotations(count: int) -> Tensor:
    """Return `count` random unit quaternions."""
    turn = torch.randn(count, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(SEED))
    return turn / turn.norm(dim=-1, keepdim=True)


FIELDS = {"true_rotation": rotations, "symmetry_group": lambda count: torch.arange(count) % 6}
KNOWN = {**FIELDS, "true_log_density": lambda count: 3 + 0.1 * torch.arange(count).double().sin()}
LEFT_OUT: Mapping[str, str] = {
    **dict.fromkeys(
        ("batches do not matter", "order does not matter", "states merge", "reset and copy"),
        "the drawn rotations depend on earlier random numbers",
    ),
    "perfect beats random": "the spread is around the true rotations, which in this row are not those of the targets",
}
ROWS = {
    "symmetric_rotation": (
        MetricRow("known optimum", TARGET, fields=KNOWN, leave_out=LEFT_OUT),
        MetricRow("no known optimum", TARGET, {"draws": 20}, fields=FIELDS, leave_out=LEFT_OUT),
    )
}
