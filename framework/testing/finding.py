"""What one check found: its worst case and how far that is from the limit."""

import math
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

SEED = 20260


def seed(number: int) -> None:
    """Seeds what a check draws, which is all on the processor."""
    # Not torch.manual_seed: for every device that is not in use it formats the stack, 0.5 ms in all.
    torch.default_generator.manual_seed(number)


@dataclass(frozen=True)
class Finding:
    """One line of the contract's table.

    Attributes:
        name: what must hold.
        worst: the worst case in words; why, where it failed.
        error: how wrong it is, in the property's own measure; NaN where something came out NaN, infinite where the
            plugin raised or did not end.
        limit: the largest error that passes.
    """

    name: str
    worst: str
    error: float
    limit: float

    @property
    def holds(self) -> bool:
        return self.error <= self.limit  # NaN does not

    def __str__(self) -> str:
        verdict = "holds" if self.holds else "FAILS"
        return f"{self.name} {verdict}: error {self.error:.3g}, limit {self.limit:g} ({self.worst})"


class Worst:
    """Keeps the worst of what it sees.

    Attributes:
        rows: what the batch rows of the densities looked at are, where a number does not say it.
    """

    def __init__(self) -> None:
        self.error = -torch.inf
        self.case = "nothing to compare"
        self.rows: Sequence[str] = ()

    def row(self, index: int) -> str:
        return self.rows[index] if self.rows else f"batch row {index}"

    def see(self, error: float | Tensor, case: str | Callable[[tuple[int, ...]], str]) -> None:
        """An error, or a tensor of them with a description by index. Nothing is worse than NaN."""
        if not isinstance(error, Tensor):
            error = torch.tensor(float(error), dtype=torch.float64)
        if error.numel() == 0:
            return
        flat = error.detach().double().flatten()
        index = int(flat.argmax())  # that of the first NaN, if there is one
        if not flat[index].item() <= self.error and not math.isnan(self.error):
            self.error = flat[index].item()
            # torch's own imports a symbolic algebra, 0.4 s
            at = tuple(int(number) for number in np.unravel_index(index, error.shape))
            self.case = case if isinstance(case, str) else case(at)

    def count(self, wrong: Tensor | bool, case: str) -> None:
        """How many of a yes-or-no property's numbers are wrong."""
        self.see(float(wrong.sum()) if isinstance(wrong, Tensor) else float(wrong), case)

    def same(self, what: str, found: object, wanted: object) -> None:
        """Something that must be equal: a shape, a type."""
        self.count(found != wanted, f"{what}: {found}" + (f", wanted {wanted}" if found != wanted else ""))

    def same_bits(self, what: str, found: Tensor, wanted: Tensor) -> None:
        """The largest difference of two tensors that must not differ in a bit; NaN equals NaN."""
        if found.shape != wanted.shape or found.dtype != wanted.dtype:
            self.see(
                torch.inf,
                f"{what}: {found.dtype} {tuple(found.shape)}, wanted {wanted.dtype} {tuple(wanted.shape)}",
            )
            return
        equal = (found == wanted) | (found.isnan() & wanted.isnan())
        gap = (found.double() - wanted.double()).abs()
        self.see(gap.where(~equal, 0), what)

    def finite(self, what: str, found: Tensor) -> None:
        self.count(
            ~found.isfinite(), f"{what}: {int((~found.isfinite()).sum())} of {found.numel()} not finite"
        )

    def finding(self, name: str, limit: float) -> Finding:
        # a check that compared nothing has shown nothing
        error = torch.inf if self.error == -torch.inf else self.error
        case = f"NaN: {self.case}" if math.isnan(error) else self.case
        return Finding(name, case, error if math.isnan(error) else max(error, 0.0), limit)


class TooSlow(Exception):
    """A check did not end in time."""


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Ends a check that has used more processor time; only where a process can have such an alarm, in its main thread.

    Processor time, not the clock's: a busy machine must not make a sound plugin fail.
    """
    if not hasattr(signal, "ITIMER_PROF") or threading.current_thread() is not threading.main_thread():
        yield
        return

    def ring(number: int, frame: Any) -> None:
        raise TooSlow(f"did not end within {seconds:g} s of processor time")

    before = signal.signal(signal.SIGPROF, ring)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def examined(name: str, limit: float, look: Callable[[Worst], None], *, seconds: float = 20.0) -> Finding:
    """The finding of one check: whatever it raises, or its not ending, is an infinite error."""
    worst = Worst()
    seed(SEED)
    try:
        with at_most(seconds):
            look(worst)
    except Exception as error:
        told = " ".join(f"{type(error).__name__}: {error}".split())
        return Finding(name, told if len(told) <= 300 else told[:297] + "...", torch.inf, limit)
    return worst.finding(name, limit)


def require(*findings: Finding) -> None:
    """For tests.

    Raises:
        AssertionError: something does not hold; says all of it.
    """
    assert findings, "nothing was examined"
    failed = [str(finding) for finding in findings if not finding.holds]
    assert not failed, "\n".join(failed)
