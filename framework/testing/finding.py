"""Result of one check: its worst case, and how far that is from the limit."""

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
    """Seed the default CPU generator, which all random numbers of a check come from."""
    # torch.manual_seed also formats the stack for every device that is not in use, 0.5 ms in all
    torch.default_generator.manual_seed(number)


@dataclass(frozen=True)
class Finding:
    """One line of the contract's table.

    Attributes:
        name: Property that must hold.
        worst: Worst case in words; the reason, where the property does not hold.
        error: Size of the error in the property's own measure; NaN where a result was NaN, infinite where the plugin
            raised an error or did not end in time.
        limit: Largest error that passes.
    """

    name: str
    worst: str
    error: float
    limit: float

    @property
    def holds(self) -> bool:
        """Return whether the error is within the limit, which NaN is not."""
        return self.error <= self.limit  # false for NaN

    def __str__(self) -> str:
        verdict = "holds" if self.holds else "FAILS"
        return f"{self.name} {verdict}: error {self.error:.3g}, limit {self.limit:g} ({self.worst})"


class Worst:
    """Recorder of the worst case among errors.

    Attributes:
        rows: Descriptions of the batch rows of the densities, used where a row number says too little.
    """

    def __init__(self) -> None:
        self.error = -torch.inf
        self.case = "nothing to compare"
        self.rows: Sequence[str] = ()

    def row(self, index: int) -> str:
        """Return the description of a batch row."""
        return self.rows[index] if self.rows else f"batch row {index}"

    def see(self, error: float | Tensor, case: str | Callable[[tuple[int, ...]], str]) -> None:
        """Record an error, or a tensor of errors, if it is the worst so far; NaN is worse than every number.

        Args:
            error: Number, or tensor of any shape.
            case: Description of the case, or a function from the index of the worst error to it.
        """
        if not isinstance(error, Tensor):
            error = torch.tensor(float(error), dtype=torch.float64)
        if error.numel() == 0:
            return
        flat = error.detach().double().flatten()
        index = int(flat.argmax())  # the index of the first NaN, if there is one
        if not flat[index].item() <= self.error and not math.isnan(self.error):
            self.error = flat[index].item()
            # torch's own unravel_index imports a symbolic algebra package, 0.4 s
            at = tuple(int(number) for number in np.unravel_index(index, error.shape))
            self.case = case if isinstance(case, str) else case(at)

    def count(self, wrong: Tensor | bool, case: str) -> None:
        """Record the number of wrong values of a yes-or-no property."""
        self.see(float(wrong.sum()) if isinstance(wrong, Tensor) else float(wrong), case)

    def same(self, what: str, found: object, wanted: object) -> None:
        """Record an error of 1 unless two objects, such as shapes or types, are equal."""
        self.count(found != wanted, f"{what}: {found}" + (f", wanted {wanted}" if found != wanted else ""))

    def same_bits(self, what: str, found: Tensor, wanted: Tensor) -> None:
        """Record the largest difference of two tensors that must agree to the last bit; NaN equals NaN."""
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
        """Record the number of values that are NaN or infinite."""
        self.count(
            ~found.isfinite(), f"{what}: {int((~found.isfinite()).sum())} of {found.numel()} not finite"
        )

    def finding(self, name: str, limit: float) -> Finding:
        """Return the finding; it fails if no error was recorded, since nothing was compared."""
        # a check that compared nothing has shown nothing
        error = torch.inf if self.error == -torch.inf else self.error
        case = f"NaN: {self.case}" if math.isnan(error) else self.case
        return Finding(name, case, error if math.isnan(error) else max(error, 0.0), limit)


class TooSlow(Exception):
    """Error of a check that did not end in time."""


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Raise TooSlow in a block that uses more than `seconds` of processor time.

    The limit applies only in the main thread and on systems that have such an alarm. It counts processor time rather
    than elapsed time, so that a busy machine does not make a sound plugin fail.

    Raises:
        TooSlow: The block used more processor time.
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
    """Run one check and return its finding; an exception, or no end in time, counts as an infinite error."""
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
    """Assert that all findings hold; for tests.

    Raises:
        AssertionError: A finding does not hold, or there is none; the message lists all that fail.
    """
    assert findings, "nothing was examined"
    failed = [str(finding) for finding in findings if not finding.holds]
    assert not failed, "\n".join(failed)
