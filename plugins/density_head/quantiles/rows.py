"""Contract-test cases: heads of quantiles, with log-densities by exact arithmetic."""

from collections.abc import Iterator

import mpmath
import torch

from framework.density_head import DensityHead
from framework.target import Target
from framework.testing.rows import Case, HeadRow

ONE = Target("real", ("height",))
OFFSETS = (0.0, 0.25, -1.0, 3.0, 40.0, -1e6)


def cases(head: DensityHead) -> Iterator[Case]:
    """Yield cases with the middle quantile 0 and equal distances of neighbouring quantiles."""
    levels, tail, floor = head.size, mpmath.mpf(head.tail), mpmath.mpf(head.floor)  # type: ignore[arg-type]
    for raw_step in (-100.0, -1.0, 0.0, 4.0):
        raw = torch.full((len(OFFSETS), levels), raw_step, dtype=torch.float64)
        raw[:, levels // 2] = 0.0
        log_prob = []
        with mpmath.workdps(50):
            factor = mpmath.e ** mpmath.mpf(raw_step) if raw_step < 0 else (1 + mpmath.mpf(raw_step) / 4) ** 4
            step = floor + factor * 4 / levels
            end = step * (levels // 2)
            for offset in OFFSETS:
                height = -mpmath.log((levels + 1) * step)
                distance = max(0, abs(mpmath.mpf(offset)) - end) / step
                fall = distance if tail == 0 else (1 + 1 / tail) * mpmath.log1p(tail * distance)
                log_prob.append(float(height - fall))
        value = torch.tensor(OFFSETS, dtype=torch.float64)[:, None]
        yield Case(f"r = {raw_step:g}", raw, value, torch.tensor(log_prob, dtype=torch.float64))


STEPS = "the check integrates smooth densities; test_quantiles.py integrates between the quantiles"
LEFT_OUT = {
    "calibrate does not harm": "the calibration is that of the quantiles, not of the likelihood",
    **dict.fromkeys(("integral", "entropy", "median", "cdf", "mean and variance"), STEPS),
}
ROWS = {
    "quantiles": (
        HeadRow("five levels", ONE, {"levels": 5}, cases=cases, leave_out=LEFT_OUT),
        HeadRow("exponential tails", ONE, {"levels": 3, "tail": 0.0}, cases=cases, leave_out=LEFT_OUT),
        HeadRow("defaults", ONE, cases=cases, leave_out=LEFT_OUT),
    )
}
