"""Contract-test cases: Gaussian heads, with log-densities from a 50-digit reference."""

from collections.abc import Iterator
from typing import Any

import mpmath
import torch

from framework.density_head import DensityHead
from framework.target import Target
from framework.testing.rows import Case, HeadRow
from plugins.density_head.gaussian.head import GaussianHead

ONE = Target("real", ("height",))
TWO = Target("real", ("x", "y"))
THREE = Target("real", ("x", "y", "z"))
OFFSETS = (0.0, 1e-6, 1.0, -3.0, 40.0, 1e6)


def exact(residual: list[float], scale: list[Any]) -> Any:
    """Return the log-density Σ -(d/σ)²/2 - log σ - log(2π)/2 (eq. 2.8), nats, as an mpmath number.

    d are the numbers in `residual`, and σ those in `scale`.
    """
    return sum(
        -((mpmath.mpf(d) / s) ** 2) / 2 - mpmath.log(s) - mpmath.log(2 * mpmath.pi) / 2
        for d, s in zip(residual, scale, strict=True)
    )


def predicted_cases(head: DensityHead) -> Iterator[Case]:
    """Yield cases with σ = floor + exp(r) or floor + (1 + r/4)⁴, mean 0, and coefficients of 0 for several numbers."""
    assert isinstance(head, GaussianHead)
    numbers = head.numbers
    floor = mpmath.mpf(head.floor)  # pyright: ignore[reportArgumentType]  # a number of this head
    for log_scale in (-100.0, -9.0, -1.0, 0.0, 2.0, 40.0, 1e4):
        with mpmath.workdps(50):
            r = mpmath.mpf(log_scale)
            largest = mpmath.mpf(10) ** 12
            scale = floor + (mpmath.e**r if r < 0 else min((1 + r / 4) ** 4, largest))
            value = torch.tensor(OFFSETS, dtype=torch.float32).double()
            value = torch.stack([value.roll(number) for number in range(numbers)], -1)
            raw = torch.zeros(len(OFFSETS), head.size, dtype=torch.float64)
            raw[:, numbers : 2 * numbers] = log_scale
            log_prob = [float(exact(row, [scale] * numbers)) for row in value.tolist()]
        yield Case(f"r = {log_scale:g}", raw, value, torch.tensor(log_prob, dtype=torch.float64))


ROWS = {
    "gaussian": (
        HeadRow("one number", ONE, cases=predicted_cases),
        HeadRow("three numbers", THREE, cases=predicted_cases, scale=0.5),
        HeadRow("full covariance", THREE, {"covariance": "full"}, cases=predicted_cases, scale=0.5),
        HeadRow("two correlated numbers", TWO, {"covariance": "full"}, cases=predicted_cases),
        HeadRow("one spread for all", THREE, {"scale": "fixed", "covariance": "full"}),
        HeadRow(
            "balanced",
            THREE,
            {"balance": 0.5, "covariance": "full"},
            scale=0.5,
            leave_out={
                "loss gradient": "`balance` weights the gradient of the loss on purpose (test_gaussian.py)"
            },
        ),
        HeadRow("least spread 0.1", ONE, {"floor": 0.1}, cases=predicted_cases),
    )
}
