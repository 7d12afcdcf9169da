"""Contract-test cases: heads of Student's t, with log-densities from a 50-digit reference."""

import itertools
from collections.abc import Iterator
from typing import Any

import mpmath
import torch

from framework.density_head import DensityHead
from framework.target import Target
from framework.testing.rows import Case, HeadRow
from plugins.density_head.student_t.density import NORMAL
from plugins.density_head.student_t.evidential import LEAST_ALPHA, LEAST_EVIDENCE, EvidentialHead
from plugins.density_head.student_t.head import StudentTHead

ONE = Target("real", ("height",))
TWO = Target("real", ("x", "y"))
OFFSETS = (0.0, 1e-6, 1.0, -3.0, 40.0, 1e6)


def exact(residual: list[float], scale: Any, freedom: Any) -> Any:
    """Return the log-density of independent numbers whose distances from their locations are `residual`, nats.

    The result is an mpmath number.
    """
    half = mpmath.mpf(freedom) / 2
    constant = mpmath.loggamma(half + 0.5) - mpmath.loggamma(half) - mpmath.log(2 * half * mpmath.pi) / 2
    return sum(
        constant - mpmath.log(scale) - (half + 0.5) * mpmath.log1p((mpmath.mpf(d) / scale) ** 2 / (2 * half))
        for d in residual
    )


def map_of_raw(raw: float) -> Any:
    """Return σ(r) = exp(r) for r < 0 and (1 + r/4)⁴ otherwise, at most 1e12, as an mpmath number."""
    r = mpmath.mpf(raw)
    return mpmath.e**r if r < 0 else min((1 + r / 4) ** 4, mpmath.mpf(10) ** 12)


def cases(head: DensityHead) -> Iterator[Case]:
    """Yield cases with location 0, many scales and, where they are predicted, many degrees of freedom."""
    assert isinstance(head, StudentTHead)
    numbers, predicted, fixed = head.numbers, head.predicted, head.fixed
    for log_scale in (-100.0, -9.0, -1.0, 0.0, 2.0, 40.0, 1e4):
        for log_freedom in (-100.0, -1.0, 0.0, 3.0, 100.0, 1e4) if predicted else (0.0,):
            raw = torch.zeros(len(OFFSETS), head.size, dtype=torch.float64)
            raw[:, numbers : 2 * numbers] = log_scale
            raw[:, 2 * numbers :] = log_freedom
            value = torch.tensor(OFFSETS, dtype=torch.float32).double()
            value = torch.stack([value.roll(number) for number in range(numbers)], -1)
            with mpmath.workdps(50):
                scale = mpmath.mpf(head.floor) + map_of_raw(log_scale)
                freedom = 3 + min(8 * map_of_raw(log_freedom), mpmath.mpf(10) ** 8) if predicted else fixed
                log_prob = [float(exact(row, scale, freedom)) for row in value.tolist()]
            name = f"r = {log_scale:g}" + (f", {log_freedom:g}" if predicted else "")
            yield Case(name, raw, value, torch.tensor(log_prob, dtype=torch.float64))


def evidential_cases(head: DensityHead) -> Iterator[Case]:
    """Yield cases with location 0, and every combination of small and large evidence and scales."""
    assert isinstance(head, EvidentialHead)
    for raws in itertools.product((-100.0, -1.0, 0.0, 3.0, 1e4), (-100.0, -1.0, 2.0, 1e4), (-9.0, 0.0, 5.0)):
        raw = torch.zeros(len(OFFSETS), head.size, dtype=torch.float64)
        for number, part in enumerate(raws, 1):
            raw[:, number * head.numbers : (number + 1) * head.numbers] = part
        value = torch.tensor(OFFSETS, dtype=torch.float32).double()
        value = torch.stack([value.roll(number) for number in range(head.numbers)], -1)
        with mpmath.workdps(50):
            nu, alpha, root_beta = (map_of_raw(part) for part in raws)
            nu, alpha = mpmath.mpf(LEAST_EVIDENCE) + nu, mpmath.mpf(LEAST_ALPHA) + min(alpha, NORMAL / 4)
            scale = mpmath.mpf(head.floor) + mpmath.sqrt(root_beta**2 * (1 + nu) / (nu * alpha))
            log_prob = [float(exact(row, scale, 2 * alpha)) for row in value.tolist()]
        yield Case(f"r = {raws}", raw, value, torch.tensor(log_prob, dtype=torch.float64))


PENALISED: dict[str, str] = dict.fromkeys(
    ("loss gradient", "loss is least for its own density"),
    "the penalty of wrong evidence is a part of the gradient only (test_evidential.py)",
)
WEIGHTED = {"loss gradient": "`balance` weights the gradient of the loss on purpose (test_student_t.py)"}
ROWS = {
    "student_t": (
        HeadRow("calibrated", ONE, cases=cases, leave_out=WEIGHTED),
        HeadRow("predicted", ONE, {"degrees_of_freedom": "predicted", "balance": 0.0}, cases=cases),
        HeadRow("two numbers", TWO, {"degrees_of_freedom": 4.5, "balance": 0.0}, cases=cases, scale=0.5),
        HeadRow(
            "heavy tails", ONE, {"degrees_of_freedom": 2.5, "floor": 0.1}, cases=cases, leave_out=WEIGHTED
        ),
    ),
    "evidential": (
        HeadRow("one number", ONE, cases=evidential_cases, leave_out=PENALISED),
        HeadRow("two numbers", TWO, {"evidence_weight": 0.0}, cases=evidential_cases, scale=0.5),
    ),
}
