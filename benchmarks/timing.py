"""Time measurements: interleaved rounds of several functions, repeated calls of one function, and first calls."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from benchmarks.commands import ROOT

ROUNDS = 5
BUSY = 0.25
"""Largest number of cores that other processes may use, on average, when a measurement starts."""


@dataclass(frozen=True)
class Rounds:
    """Milliseconds of one function, or ratios of two functions: one number for each round."""

    milliseconds: tuple[float, ...]

    @property
    def median(self) -> float:
        """Median over the rounds."""
        return median(self.milliseconds)

    def text(self, digits: int = 3) -> str:
        """Return the median and, in brackets, the smallest and the largest round as text."""
        return median_and_range(self.milliseconds, digits)

    def speedup(self, other: "Rounds") -> "Rounds":
        """Return for each round how many times as fast this function is as another."""
        return Rounds(tuple(b / a for a, b in zip(self.milliseconds, other.milliseconds, strict=True)))

    def times_faster(self, than: "Rounds", digits: int = 2) -> str:
        """Return as text how many times as fast this function is as another: median (smallest to largest round)."""
        return self.speedup(than).text(digits)


def median_and_range(numbers: Sequence[float], digits: int = 3) -> str:
    """Return the median and, in brackets, the smallest and the largest number as text."""
    low, middle, high = (
        _format_plain(number, digits) for number in (min(numbers), median(numbers), max(numbers))
    )
    return f"{middle} ({low} to {high})"


def time_interleaved(
    functions: Mapping[str, Callable[[], object]],
    *,
    rounds: int = ROUNDS,
    seconds: float = 0.3,
    clock: Callable[[], float] = time.process_time,
) -> dict[str, Rounds]:
    """Time several functions in interleaved rounds, so that other load on the machine affects all of them.

    In each round a function is called repeatedly for about `seconds`, at least three times; its time in the round is
    the median of these calls. Before the first round, each function is called twice to warm up.

    Args:
        functions: functions to time, by name.
        rounds: number of rounds.
        seconds: time in seconds for which a function is called in a round.
        clock: function that returns processor or wall time in seconds.

    Returns:
        Milliseconds of each function, by name.
    """
    for call in functions.values():
        call()
        call()
    milliseconds_of_rounds: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(rounds):
        for name, call in functions.items():
            milliseconds_of_rounds[name].append(median(times_of_calls(call, seconds, clock)))
    return {name: Rounds(tuple(times)) for name, times in milliseconds_of_rounds.items()}


def times_of_calls(call: Callable[[], object], seconds: float, clock: Callable[[], float]) -> list[float]:
    """Return the milliseconds of repeated calls of a function, at least three, for `seconds` of the clock in all."""
    times: list[float] = []
    while len(times) < 3 or sum(times) < seconds:
        start = clock()
        call()
        times.append(clock() - start)
    return [1e3 * duration for duration in times]


def require_idle() -> None:
    """Exit with a message if other processes use the machine, because such times cannot be reproduced.

    Raises:
        SystemExit: other processes use more than `BUSY` cores.
    """
    used = cores_used_by_others()
    if used > BUSY:
        sys.exit(
            f"Other processes use {used:.2f} cores, but at most {BUSY} are allowed, so that the times can be "
            "reproduced. Nothing was written. End the other processes and run the script again."
        )


def cores_used_by_others(seconds: float = 2.0) -> float:
    """Return the number of cores that other processes use, averaged over some seconds (on Linux; elsewhere 0)."""
    if not Path("/proc/stat").is_file():
        return 0.0
    before, own = _total_processor_seconds(), time.process_time()
    time.sleep(seconds)
    return max(0.0, (_total_processor_seconds() - before - (time.process_time() - own)) / seconds)


@contextmanager
def busy_core(wanted: bool) -> Iterator[None]:
    """Keep one core busy by another process during the block, if `wanted` is true."""
    if not wanted:
        yield
        return
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        yield
    finally:
        process.kill()
        process.wait()


def first_calls(script: str, **variables: str) -> tuple[float, float]:
    """Return the seconds that a script prints in a new process, with an empty cache of code and with a full one.

    Args:
        script: Python code that prints a number of seconds.
        variables: additional environment variables; "{}" in a value is replaced by the folder of the cache.
    """
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, **{name: value.format(folder) for name, value in variables.items()}}
        cold, warm = (
            subprocess.run(
                [sys.executable, "-c", script],
                env=environment, cwd=ROOT, check=True, capture_output=True, text=True,
            ).stdout
            for _ in range(2)
        )  # fmt: skip
    return float(cold), float(warm)


def milliseconds(
    call: Callable[[], object],
    repeats: int = 300,
    clock: Callable[[], float] = time.thread_time,
    warm_up: int = 10,
) -> float:
    """Return the median time of a call in milliseconds, after calls to warm up; by default the thread's processor time.

    Args:
        call: function to time.
        repeats: number of timed calls.
        clock: function that returns seconds.
        warm_up: number of calls before the timed calls.
    """
    for _ in range(warm_up):
        call()
    times = []
    for _ in range(repeats):
        start = clock()
        call()
        times.append(clock() - start)
    return 1e3 * median(times)


def _total_processor_seconds() -> float:
    """Return the processor seconds that all processes together have used since the machine started."""
    user, nice, system, *_ = Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]
    return (int(user) + int(nice) + int(system)) / os.sysconf("SC_CLK_TCK")


def _format_plain(number: float, digits: int) -> str:
    return f"{number:.{digits}g}" if abs(number) < 10**digits else f"{number:,.0f}"
