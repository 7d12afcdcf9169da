"""Contract-test cases: objects without symmetry, with twofold symmetry and with full symmetry."""

import torch
from torch import Tensor

from framework.target import Target
from framework.testing.rows import MetricRow


def symmetry(count: int) -> Tensor:
    """Return the symmetries 0, 1, 2, 0, 1, 2, ... of `count` samples."""
    return torch.arange(count) % 3


ONE_MODE = {
    "perfect beats random": "a density with a single mode at the target misses the other modes of a symmetric object"
}
ROWS = {
    "true_posterior": tuple(
        MetricRow(", ".join(names), Target("angle", names), fields={"symmetry": symmetry}, leave_out=ONE_MODE)
        for names in (("azimuth",), ("azimuth", "elevation", "tilt"))
    )
}
