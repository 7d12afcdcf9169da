"""Stopped benchmarks, which stop their commands and wait until these have ended."""

import itertools
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.commands import ROOT, carry_out
from tests.conftest import first_of_each

NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
CHILD = """
import signal, sys, time
def closed(number, frame):
    time.sleep(1.0)  # longer than the quarter of a second that subprocess.run leaves
    print("closed", signal.Signals(number).name, flush=True)
    sys.exit(3)
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, closed)
print("ready", flush=True)
time.sleep(60)
"""
BENCHMARK = """
import signal, sys
from benchmarks.commands import carry_out
for number in (signal.SIGINT, signal.SIGHUP):  # ignored where the tests run in the background or under nohup
    signal.signal(number, signal.SIG_DFL)
carry_out([sys.executable, "-c", sys.argv[1]])
"""


@pytest.mark.parametrize(
    ("number", "whole_group"),
    first_of_each(
        itertools.product(NUMBERS, (False, True)),
        lambda case: case[1],
        lambda case: f"{case[0].name} {'as from a terminal' if case[1] else 'to one process'}",
    ),
)
def test_what_it_runs_is_told_once_and_waited_for(number: signal.Signals, whole_group: bool) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", BENCHMARK, CHILD], cwd=ROOT, stdout=subprocess.PIPE, text=True, process_group=0
    ) as benchmark:
        assert benchmark.stdout is not None
        assert benchmark.stdout.readline() == "ready\n"
        if whole_group:
            subprocess.run(
                [sys.executable, "-c", f"import os; os.killpg({benchmark.pid}, {number})"], check=True
            )
        else:
            benchmark.send_signal(number)
        said = benchmark.stdout.read()
    assert said == f"closed {number.name}\n"
    assert benchmark.returncode == 128 + number


def test_a_command_that_fails_is_an_error_and_handlers_are_as_before() -> None:
    before = [signal.getsignal(number) for number in NUMBERS]
    carry_out([sys.executable, "-c", ""])
    with pytest.raises(subprocess.CalledProcessError, match="exit status 5"):
        carry_out([sys.executable, "-c", "raise SystemExit(5)"])
    with pytest.raises(FileNotFoundError):
        carry_out(["/nowhere/to/be/found"])
    assert [signal.getsignal(number) for number in NUMBERS] == before


TIMED = {"cold_start.py", "main_job.py", "predict.py", "step_overhead.py", "stores.py"}
"""Scripts that time single commands, in temporary folders, of which nothing is left if they are stopped."""


def test_every_benchmark_that_runs_the_framework_does_it_so() -> None:
    """A sweep that is started in another way would continue alone, or be killed while it writes."""
    others = [
        path.name
        for folder in ("benchmarks", "reproduction", "tests/fuzz")
        for path in Path(ROOT, folder).rglob("*.py")
        if '"-m", "framework"' in (text := path.read_text(encoding="utf-8")) and "subprocess.run(" in text
    ]
    assert set(others) <= TIMED


@pytest.mark.parametrize("package", ["benchmarks", "reproduction"])
def test_an_installed_package_of_the_same_name_does_not_hide_it(package: str) -> None:
    """A folder without `__init__.py` is hidden by any package of the same name on the path."""
    assert Path(ROOT, package, "__init__.py").is_file()
