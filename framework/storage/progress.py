"""Printing of results as plain text, and progress reports of long work: a bar on a terminal, or lines in a log file."""

import time
from collections.abc import Callable, Iterable, Iterator
from types import TracebackType
from typing import Any, TypeVar, final

from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.segment import Segment

from framework.errors import escape_unprintable
from framework.storage.first_rank import first_rank

Item = TypeVar("Item")
QUIET_TIME, REPORT_INTERVAL = 2.0, 30.0
"""Seconds from the start of the work to its first progress report, and seconds between two lines in a log file."""
WIDE = 160
"""Number of characters in a line of a log file."""


class PlainConsole(Console):
    """Console that prints every text as it is: brackets are not markup, and control characters are escaped.

    Names of methods, classes, columns and files may come from another person's checkpoint, table or folder. A control
    sequence in them could write to the clipboard of a terminal or hide text.

    Args:
        options: Arguments of `rich.console.Console`.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """Yield the segments of `Console.render`, with control characters in texts escaped."""
        for segment in super().render(renderable, options):
            # rich moves the cursor by segments with control codes, which contain no text of others
            yield segment if segment.control else Segment(escape_unprintable(segment.text), segment.style)


def output() -> Console:
    """Return the console for results, which prints on the first rank only and wraps lines in a log file at `WIDE`."""
    console = PlainConsole(quiet=not first_rank())
    return console if console.is_terminal else PlainConsole(quiet=console.quiet, width=WIDE)


@final
class Work:
    """Progress of work that consists of `total` units, reported on the error stream by the first rank only.

    Args:
        name: Name of the work, such as "testing".
        total: Number of units.
        units: Name of the units, such as "samples".
        console: Console to print on; None for the error stream.
        clock: Function that returns the time in seconds.
    """

    def __init__(
        self,
        name: str,
        total: int,
        units: str,
        *,
        console: Console | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name, self.total, self.units = name, total, units
        self.console = console or PlainConsole(stderr=True, quiet=not first_rank())
        self.clock = clock
        self.completed = 0
        self._start = clock()
        self._last_report = self._start
        self._bar: Progress | None = None

    def __enter__(self) -> "Work":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def advance(self, count: int = 1) -> None:
        """Report that another `count` units are done."""
        self.completed += count
        now = self.clock()
        if self.console.quiet or now - self._start < QUIET_TIME:
            return
        if self.console.is_terminal:
            self._show()
        elif now - self._last_report >= REPORT_INTERVAL:
            self._last_report = now
            report = (
                f"{self.name}: {self.completed} of {self.total} {self.units} in {now - self._start:.0f} s"
            )
            self.console.print(report, soft_wrap=True, highlight=False, markup=False)

    def _show(self) -> None:
        if self._bar is None:
            text = TextColumn("{task.description}", markup=False)
            shown = text, BarColumn(), MofNCompleteColumn(), TextColumn(self.units), TimeRemainingColumn()
            self._bar = Progress(*shown, console=self.console, transient=True)
            self._bar.add_task(self.name, total=self.total)
            self._bar.start()
        self._bar.update(self._bar.task_ids[0], completed=self.completed)


def track_progress(
    items: Iterable[Item], name: str, total: int, units: str, size: Callable[[Item], int] = lambda _: 1
) -> Iterator[Item]:
    """Yield the items, and report progress as the consumer takes them.

    Args:
        items: Items of the work.
        name: Name of the work, such as "testing".
        total: Number of units of all items.
        units: Name of the units, such as "samples".
        size: Function that returns the number of units of an item.
    """
    with Work(name, total, units) as work:
        for item in items:
            yield item
            work.advance(size(item))
