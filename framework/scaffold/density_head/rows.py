"""Contract rows: targets and parameters with which `mode=check` tests the plugin, and independent references."""

from collections.abc import Iterator

import torch
from mpmath import mp

from framework.density_head import DensityHead
from framework.target import Target
from framework.testing.rows import Case, HeadRow


def cases(head: DensityHead) -> Iterator[Case]:
    """Yield log-densities that mpmath computes, over scales from tiny to huge; r is the raw parameter of the scale."""
    values = (-3.0, -0.5, 0.25, 0.5, 0.75, 2.0)
    for r in (-30.0, -1.0, 0.0, 4.0, 1024.0):
        with mp.workdps(30):
            scale = mp.mpf(1e-3) + mp.log1p(mp.exp(r))
            log_prob = [float(-abs(value - mp.mpf(0.5)) / scale - mp.log(2 * scale)) for value in values]
        yield Case(
            f"r = {r:g}",
            torch.tensor([[0.5, r]], dtype=torch.float64).repeat(len(values), 1),
            torch.tensor(values, dtype=torch.float64)[:, None],
            torch.tensor(log_prob, dtype=torch.float64),
        )


ROWS = {
    "example": (
        HeadRow("one number", Target("real", ("height",)), cases=cases),
        HeadRow("two numbers", Target("real", ("x", "y")), {"smallest": 0.1}),
    )
}
