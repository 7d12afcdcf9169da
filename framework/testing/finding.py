"""Result of one check: its worst case, the error there and the largest error that passes."""

import math
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from traceback import walk_tb
from typing import Any

import numpy as np
import torch
from torch import Tensor

from framework.configuration.registry import plugin_packages
from framework.errors import UserError

SEED = 20260


def seed(number: int) -> None:
    """Seed the default CPU generator, from which all random numbers of a check are drawn."""
    # torch.manual_seed takes 0.5 ms, since it also formats the stack for every device that is not in use
    torch.default_generator.manual_seed(number)


@dataclass(frozen=True)
class Finding:
    """Result of one check of one row: a line in the table of `mode=check`.

    Attributes:
        name: Name of the property that was checked.
        worst: Description of the case with the largest error, or of the exception that the plugin raised.
        error: Largest error, in the unit of the property; NaN where a result was NaN, infinite where the plugin raised
            an exception or exceeded the time limit.
        limit: Largest error that passes.
    """

    name: str
    worst: str
    error: float
    limit: float

    @property
    def holds(self) -> bool:
        """Return whether the error is within the limit; False for NaN."""
        return self.error <= self.limit

    def __str__(self) -> str:
        verdict = "holds" if self.holds else "FAILS"
        return f"{self.name} {verdict}: error {self.error:.3g}, limit {self.limit:g} ({self.worst})"


class Worst:
    """Recorder of the largest error of a check, with a description of the case in which it occurred.

    Attributes:
        error: Largest error so far; -∞ before the first, NaN once an error was NaN.
        case: Description of the case with that error. If the error is 0, this is a case in which no fault was found.
        rows: Description of each batch row of the densities under test; empty to describe rows by their number.
    """

    def __init__(self) -> None:
        self.error = -torch.inf
        self.case = "nothing was compared"
        self.rows: Sequence[str] = ()

    def row(self, index: int) -> str:
        """Return the description of a batch row."""
        return self.rows[index] if self.rows else f"batch row {index}"

    def record(self, error: float | Tensor, case: str | Callable[[tuple[int, ...]], str]) -> None:
        """Record the largest of some errors if it exceeds all recorded before; NaN exceeds every number.

        Args:
            error: Error, or errors in a tensor of any shape.
            case: Description of the case, or a function that returns the description for the index of the largest
                error in the tensor.
        """
        if not isinstance(error, Tensor):
            error = torch.tensor(float(error), dtype=torch.float64)
        if error.numel() == 0:
            return
        flat = error.detach().double().flatten()
        index = int(flat.argmax())  # the index of the first NaN, if there is one
        if not flat[index].item() <= self.error and not math.isnan(self.error):
            self.error = flat[index].item()
            # torch.unravel_index takes 0.4 s, since it imports a symbolic algebra package
            at = tuple(int(number) for number in np.unravel_index(index, error.shape))
            self.case = case if isinstance(case, str) else case(at)

    def count(self, wrong: Tensor | bool, case: str) -> None:
        """Record the number of wrong values as the error; `wrong` is one truth value or a mask."""
        self.record(float(wrong.sum()) if isinstance(wrong, Tensor) else float(wrong), case)

    def same(self, label: str, actual: object, expected: object) -> None:
        """Record an error of 1 if two objects, such as shapes or types, differ, else 0; `label` names the objects."""
        different = actual != expected
        self.count(different, f"{label}: {actual}" + (f", expected {expected}" if different else ""))

    def same_bits(self, label: str, actual: Tensor, expected: Tensor) -> None:
        """Record the largest difference of two tensors that must be equal to the last bit; NaN equals NaN.

        The error is infinite if their shapes or types differ. `label` names the tensors in the finding.
        """
        if actual.shape != expected.shape or actual.dtype != expected.dtype:
            self.record(
                torch.inf,
                f"{label}: {actual.dtype} {tuple(actual.shape)}, expected {expected.dtype} {tuple(expected.shape)}",
            )
            return
        if actual.numel() > 0 and torch.equal(
            actual, expected
        ):  # many times faster than the search for a difference
            self.record(0.0, label)
            return
        equal = (actual == expected) | (actual.isnan() & expected.isnan())
        gap = (actual.double() - expected.double()).abs()
        self.record(gap.where(~equal, 0), label)

    def finite(self, label: str, values: Tensor) -> None:
        """Record the number of values that are NaN or infinite as the error; `label` names the values."""
        self.count(
            ~values.isfinite(), f"{label}: {int((~values.isfinite()).sum())} of {values.numel()} not finite"
        )

    def finding(self, name: str, limit: float) -> Finding:
        """Return the finding of the property `name`, which holds if the largest recorded error is at most `limit`.

        Without any recorded error nothing was compared, so that the finding does not hold.
        """
        error = torch.inf if self.error == -torch.inf else self.error
        case = f"NaN: {self.case}" if math.isnan(error) else self.case
        return Finding(name, case, error if math.isnan(error) else max(error, 0.0), limit)


class TooSlow(Exception):
    """Error of a check that exceeded its limit of processor time."""


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Raise TooSlow in a block that uses more than `seconds` of processor time.

    Processor time is used rather than elapsed time, so that no correct plugin fails on a busy machine. Outside the main
    thread, and on systems without SIGPROF, there is no limit.

    Raises:
        TooSlow: The block used more processor time.
    """
    if not hasattr(signal, "ITIMER_PROF") or threading.current_thread() is not threading.main_thread():
        yield
        return

    def raise_too_slow(number: int, frame: Any) -> None:
        raise TooSlow(f"the call did not end within {seconds:g} s of processor time")

    before = signal.signal(signal.SIGPROF, raise_too_slow)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def run_check(name: str, limit: float, check: Callable[[Worst], None], *, seconds: float = 20.0) -> Finding:
    """Run one check and return its finding; the error is infinite if it raises an exception or takes too long.

    Args:
        name: Name of the property.
        limit: Largest error that passes.
        check: Function that runs the check and records its errors.
        seconds: Limit of processor time, seconds.
    """
    worst = Worst()
    seed(SEED)
    try:
        with at_most(seconds):
            check(worst)
    except Exception as error:
        return Finding(name, describe_error(error), torch.inf, limit)
    return worst.finding(name, limit)


def describe_error(error: BaseException) -> str:
    """Return type and message of an error that a plugin raised, and the line of the plugin that raised it.

    An error without a message is described by the function that raised it.
    """
    message = " ".join(str(error).split())
    if not message:
        *_, (frame, _) = walk_tb(error.__traceback__)
        owner = frame.f_locals.get("self")
        if owner is not None:
            message = f"raised by `{frame.f_code.co_name}` of {type(owner).__name__}"
    text = f"{type(error).__name__}: {message}" if message else type(error).__name__
    return (text if len(text) <= 300 else text[:297] + "...") + _line_of(error)


def _line_of(error: BaseException) -> str:
    """Return " (raised at <file>:<line>)", the innermost line of a plugin through which an error passed.

    If it passed through no plugin, the line is the innermost one of the framework outside its checks. The result is ""
    if there is none, and for an error whose message is a sentence for users.
    """
    if isinstance(error, UserError):
        return ""
    places: dict[bool, str] = {}
    for frame, line in walk_tb(error.__traceback__):
        module = str(frame.f_globals.get("__name__"))
        package = module.partition(".")[0]
        if package in plugin_packages() or (
            package == "framework" and not module.startswith("framework.testing.")
        ):
            places[package == "framework"] = short_place(frame.f_code.co_filename, line)
    place = places.get(False) or places.get(True)
    return f" (raised at {place})" if place else ""


def short_place(path: str, line: int) -> str:
    """Return a file and a line for a message, with the last three parts of the path."""
    return f"{'/'.join(path.split('/')[-3:])}:{line}"


def failures(findings: Iterable[Finding]) -> list[str]:
    """Return the names of the findings that do not hold."""
    return [finding.name for finding in findings if not finding.holds]


def require(*findings: Finding) -> None:
    """Assert in a test that all findings hold.

    Raises:
        AssertionError: A finding does not hold, or there is none; the message lists all that fail.
    """
    assert findings, "nothing was checked"
    failed = [str(finding) for finding in findings if not finding.holds]
    assert not failed, "\n".join(failed)
