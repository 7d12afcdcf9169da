"""Times several ways of doing one thing in turn, so that all meet the same machine, and says how far rounds differ."""

import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

ROUNDS = 5
BUSY = 0.25
"""Cores that other processes may use, on average, while a page is measured."""


@dataclass(frozen=True)
class Rounds:
    """Milliseconds of one way, or a ratio of two, a number a round."""

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


def replace_section(page: Path, heading: str, text: str) -> None:
    """Replace what stands under a heading of a page, up to the next heading of its level or above.

    Raises:
        ValueError: the page has no such heading, or several.
    """
    lines = page.read_text(encoding="utf-8").splitlines()
    places = [number for number, line in enumerate(lines) if line == heading]
    if len(places) != 1:
        raise ValueError(f"{page} has {len(places)} lines {heading!r}; wanted one.")
    level = len(heading) - len(heading.lstrip("#"))
    first = places[0] + 1
    ends = (
        number
        for number in range(first, len(lines))
        if lines[number].startswith("#") and len(lines[number].split(" ")[0]) <= level
    )
    last = next(ends, len(lines))
    written = [*lines[:first], "", *text.strip().splitlines(), "", *lines[last:]]
    page.write_text("\n".join(written).rstrip() + "\n", encoding="utf-8")


def _busy() -> float:
    """Seconds of processor time that all processes have had since the machine started."""
    user, nice, system, *_ = Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]
    return (int(user) + int(nice) + int(system)) / os.sysconf("SC_CLK_TCK")


def _plain(number: float, digits: int) -> str:
    return f"{number:.{digits}g}" if abs(number) < 10**digits else f"{number:,.0f}"
