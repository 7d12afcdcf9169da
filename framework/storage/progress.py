"""What long work says of itself while it goes on: a bar on a terminal, in a log a line every half minute."""

import time
from collections.abc import Callable, Iterable, Iterator
from types import TracebackType
from typing import TypeVar, final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from framework.storage.first_rank import first_rank

Item = TypeVar("Item")
SHORT, APART = 2.0, 30.0
"""Seconds: shorter work says nothing, and lines of a log are so far apart."""
WIDE = 160
"""Characters of a line of a log."""


def output() -> Console:
    """Where people read results: a log has no edge to wrap at, and ranks other than the first print nothing."""
    console = Console(quiet=not first_rank())
    return console if console.is_terminal else Console(quiet=console.quiet, width=WIDE)


@final
class Work:
    """Work of `total` units: says how far it is, on the error stream; ranks other than the first say nothing.

    Args:
        what: is done, and `units` of what: "testing", "samples".
        clock: seconds.
    """

    def __init__(
        self,
        what: str,
        total: int,
        units: str,
        *,
        console: Console | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.what, self.total, self.units = what, total, units
        self.console = console or Console(stderr=True, quiet=not first_rank())
        self.clock = clock
        self.done = 0
        self._start = clock()
        self._told = self._start
        self._bar: Progress | None = None

    def __enter__(self) -> "Work":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def advance(self, count: int = 1) -> None:
        """Another `count` units are done."""
        self.done += count
        now = self.clock()
        if self.console.quiet or now - self._start < SHORT:
            return
        if self.console.is_terminal:
            self._show()
        elif now - self._told >= APART:
            self._told = now
            said = f"{self.what}: {self.done} of {self.total} {self.units} in {now - self._start:.0f} s"
            self.console.print(said, soft_wrap=True, highlight=False, markup=False)

    def _show(self) -> None:
        if self._bar is None:
            text = TextColumn("{task.description}", markup=False)
            shown = text, BarColumn(), MofNCompleteColumn(), TextColumn(self.units), TimeRemainingColumn()
            self._bar = Progress(*shown, console=self.console, transient=True)
            self._bar.add_task(self.what, total=self.total)
            self._bar.start()
        self._bar.update(self._bar.task_ids[0], completed=self.done)


def tracked(
    items: Iterable[Item], what: str, total: int, units: str, size: Callable[[Item], int] = lambda _: 1
) -> Iterator[Item]:
    """The items, whose consumer is the work; `size` is how many units an item has."""
    with Work(what, total, units) as work:
        for item in items:
            yield item
            work.advance(size(item))
