"""Tests of progress reports: none for short work, a bar on a terminal, lines in a log, and none in other ranks."""

import ast
import io
import logging
import re
from pathlib import Path

import pytest
from rich.console import Console
from rich.table import Table
from rich.text import Text

from framework.storage.log_messages import PlainLogRecord, log_each_message_once
from framework.storage.progress import QUIET_TIME, REPORT_INTERVAL, PlainConsole, Work, track_progress


class Clock:
    """Clock that advances only when a test sets it."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def said(seconds: float, steps: int, *, terminal: bool = False, quiet: bool = False) -> str:
    """Return the progress report of work that takes `seconds` in equal `steps`."""
    clock, out = Clock(), io.StringIO()
    console = Console(file=out, force_terminal=terminal, width=100, quiet=quiet)
    with Work("reading [b]", steps, "files", console=console, clock=clock) as work:
        for _ in range(steps):
            clock.now += seconds / steps
            work.advance()
    return out.getvalue()


@pytest.mark.parametrize("terminal", [False, True])
@pytest.mark.parametrize("steps", [1, 4, 1000])
def test_short_work_and_other_ranks_say_nothing(terminal: bool, steps: int) -> None:
    assert said(0.99 * QUIET_TIME, steps, terminal=terminal) == ""
    assert said(1e4, steps, terminal=terminal, quiet=True) == ""


def test_a_log_gets_a_line_every_half_minute() -> None:
    assert said(0.99 * REPORT_INTERVAL, 100) == ""
    lines = said(126, 504).splitlines()  # a step is a quarter of a second
    assert len(lines) == 4
    assert lines[0] == "reading [b]: 120 of 504 files in 30 s"
    assert lines[-1] == "reading [b]: 480 of 504 files in 120 s"
    assert len(said(10 * REPORT_INTERVAL, 5).splitlines()) == 5  # seldom heard of: each time


def test_a_terminal_gets_a_bar_that_goes_away() -> None:
    found = said(10 * QUIET_TIME, 10, terminal=True)
    assert "reading [b]" in found and "10/10" in found and "files" in found
    assert found.endswith("\x1b[2K")  # the line is wiped, whatever comes next stands in its place


def test_items_pass_through_and_count_by_their_size(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, told = Clock(), []
    monkeypatch.setattr("framework.storage.progress.time.monotonic", clock)
    monkeypatch.setattr(Work, "advance", lambda self, count: told.append((self.name, self.total, count)))
    assert list(track_progress(["a", "bcd"], "adding", 4, "letters", len)) == ["a", "bcd"]
    assert told == [("adding", 4, 1), ("adding", 4, 3)]


@pytest.mark.parametrize(
    ("variables", "first"),
    [({}, True), ({"RANK": "1", "WORLD_SIZE": "2"}, False), ({"RANK": "0", "WORLD_SIZE": "2"}, True)],
)
def test_only_the_first_rank_speaks(
    variables: dict[str, str], first: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK", "NODE_RANK", "SLURM_PROCID", "SLURM_NTASKS"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert Work("testing", 1, "samples").console.quiet is not first


STEERING = "a\x1b]52;c;eA==\x1b\\[/red][bold]\u202e\r\x9b2J\x07b"
"""A name that writes to the clipboard, reverses the direction of text, returns to the start of the line, and clears."""


def table(*, title: str | Text) -> Table:
    found = Table(STEERING, STEERING, title=title)
    found.add_row(STEERING, Text(STEERING))
    return found


@pytest.mark.parametrize("terminal", [False, True])
@pytest.mark.parametrize(
    "thing",
    [STEERING, Text(STEERING), table(title=STEERING), table(title=Text(STEERING)), [STEERING]],
    ids=type,
)
@pytest.mark.parametrize("soft_wrap", [False, True])
def test_a_name_of_another_person_steers_no_terminal(thing: object, terminal: bool, soft_wrap: bool) -> None:
    out = io.StringIO()
    console = PlainConsole(file=out, force_terminal=terminal, color_system=None, width=300, highlight=False)
    console.print(thing, soft_wrap=soft_wrap)
    said = out.getvalue()
    if terminal:  # rich's own codes set colours and widths only
        said = re.sub(r"\x1b\[[\d;]*m", "", said)
    assert all(letter.isprintable() or letter == "\n" for letter in said), ascii(said)
    assert "x1b]52;c;eA==" in said and "[/red][bold]" in said


def test_the_message_of_a_log_steers_no_terminal() -> None:
    record = PlainLogRecord("a", logging.WARNING, "a.py", 1, "weights %s", (STEERING,), None)
    assert record.getMessage().isprintable()
    assert record.getMessage().startswith("weights a\\x1b]52;c;eA==")


def test_a_check_writes_each_message_of_a_log_once(caplog: pytest.LogCaptureFixture) -> None:
    log = logging.getLogger("framework.planted")
    with log_each_message_once():
        for _ in range(3):
            log.warning("the mass of %d densities", 2)
            log.warning("the mass of %d densities", 3)
    assert [record.getMessage() for record in caplog.records] == [
        f"the mass of {n} densities" for n in (2, 3)
    ]
    log.warning("the mass of %d densities", 2)
    assert len(caplog.records) == 3


def test_no_other_module_makes_a_console() -> None:
    root = Path(__file__).parent.parent
    made = {
        file.relative_to(root).as_posix()
        for top in ("framework", "plugins", "hydra_plugins")
        for file in (root / top).rglob("*.py")
        if not file.name.startswith("test_")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in ("Console", "print")
        if not (isinstance(node.func, ast.Attribute) and node.func.attr == "print")
    }
    assert made <= {"framework/storage/progress.py"}, "Use framework.storage.progress.PlainConsole or output."
