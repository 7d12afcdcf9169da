"""Timing: several ways in turn, so that all meet the same machine, how far rounds differ, single calls, first calls."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from benchmarks.commands import ROOT

ROUNDS = 5
BUSY = 0.25
"""Cores that other processes may use, on average, while a page is measured."""


@dataclass(frozen=True)
class Rounds:
    """Milliseconds of one way, or ratios of two ways, one number for each round."""

    milliseconds: tuple[float, ...]

    @property
    def median(self) -> float:
        """Middle of the rounds."""
        return median(self.milliseconds)

    def text(self, digits: int = 3) -> str:
        """Write the median and, in brackets, the least and the largest round."""
        return median_and_range(self.milliseconds, digits)

    def over(self, other: "Rounds") -> "Rounds":
        """Return by round how many times as fast this way is as another."""
        return Rounds(tuple(b / a for a, b in zip(self.milliseconds, other.milliseconds, strict=True)))

    def times_faster(self, than: "Rounds", digits: int = 2) -> str:
        """Write how many times as fast this way is as another: median (least to largest)."""
        return self.over(than).text(digits)


def median_and_range(numbers: Sequence[float], digits: int = 3) -> str:
    """Write the median and, in brackets, the least and the largest number."""
    low, middle, high = (_plain(number, digits) for number in (min(numbers), median(numbers), max(numbers)))
    return f"{middle} ({low} to {high})"


def in_turn(
    ways: Mapping[str, Callable[[], object]],
    *,
    rounds: int = ROUNDS,
    seconds: float = 0.3,
    clock: Callable[[], float] = time.process_time,
) -> dict[str, Rounds]:
    """Time the ways in turn; a round of a way is the median of the calls that fit into `seconds`, at least three.

    Each way is called twice before, to warm up.

    Args:
        ways: what to call, by name.
        rounds: how many turns.
        seconds: how long a way is called in a round.
        clock: processor or wall time, seconds.
    """
    for call in ways.values():
        call()
        call()
    found: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, call in ways.items():
            times: list[float] = []
            while len(times) < 3 or sum(times) < seconds:
                start = clock()
                call()
                times.append(clock() - start)
            found[name].append(1e3 * median(times))
    return {name: Rounds(tuple(times)) for name, times in found.items()}


def require_idle() -> None:
    """Leave with a sentence where other processes use the machine: a page that is measured then does not reproduce.

    Raises:
        SystemExit: others use more than `BUSY` cores.
    """
    used = others_use()
    if used > BUSY:
        sys.exit(
            f"Other processes use {used:.2f} cores; wanted at most {BUSY}, for figures that reproduce. Nothing is "
            "written. End them and run this again."
        )


def others_use(seconds: float = 2.0) -> float:
    """Return how many cores other processes use, on average over so many seconds (Linux; 0 elsewhere)."""
    if not Path("/proc/stat").is_file():
        return 0.0
    before, own = _busy(), time.process_time()
    time.sleep(seconds)
    return max(0.0, (_busy() - before - (time.process_time() - own)) / seconds)


def first_calls(script: str, **elsewhere: str) -> tuple[float, float]:
    """Return the seconds that a script prints in a fresh process: with nothing compiled, and with a full cache.

    Args:
        elsewhere: further environment; the cache of compiled code is in the folder {} of a value.
    """
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, **{name: value.format(folder) for name, value in elsewhere.items()}}
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
    """Return the median milliseconds of a call after calls to warm up; by default the thread's processor time."""
    for _ in range(warm_up):
        call()
    times = []
    for _ in range(repeats):
        start = clock()
        call()
        times.append(clock() - start)
    return 1e3 * median(times)


def _busy() -> float:
    """Return the processor seconds that all processes have had since the machine started."""
    user, nice, system, *_ = Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]
    return (int(user) + int(nice) + int(system)) / os.sysconf("SC_CLK_TCK")


def _plain(number: float, digits: int) -> str:
    return f"{number:.{digits}g}" if abs(number) < 10**digits else f"{number:,.0f}"
