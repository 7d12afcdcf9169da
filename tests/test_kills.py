"""Killed processes of runs and sweeps: all other processes end, and the run is closed."""

import ast
import json
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from framework.tracking.ended import mark_dead
from tests.fuzz.kills import ROOT, Command, differences, status
from tests.test_pool import App

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="elsewhere nothing tells a process that its parent has died"
)
LOADED = 25.0
"""Limit of the time until all processes end, seconds; on an idle machine 10 suffice (tests/fuzz/kills.md)."""
RUN = """
import json, os, signal, sys, threading, time
from pathlib import Path
from framework.tracking.tracker import NoTracker
from framework.tracking.watch import start_watcher

folder, how = Path(sys.argv[1]), sys.argv[2]
tracker = NoTracker(folder)
with start_watcher(folder):
    tracker.open()
    tracker.log_metrics({"train/loss": 1.0}, 1, 0)
    if how == "closes":
        tracker.close("FINISHED")
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # as while compiled code runs
    (folder / "ready").touch()
    time.sleep(0 if how == "closes" else 100)
"""
PARENT = """
import subprocess, sys, time
from framework.tracking.signals import end_with_parent
jobs = [
    subprocess.Popen([sys.executable, "-c", *sys.argv[1:3], how], preexec_fn=ends, start_new_session=True)
    for how, ends in zip(sys.argv[3:], (end_with_parent(), None))
]
time.sleep(100)
"""


FOREST = (
    *("data=moons", "density_head=extra_trees", "density_head.trees=5", "encoder=[]"),
    *("metric=[accuracy]", "logger=none", "pictures=false", "threads=1"),
)


class Lives:
    """Run that is killed in the middle, and that continues with each call.

    Args:
        words: of the command.
        base: folder for the run and its output.
        packages: on Python's path.
    """

    def __init__(self, words: Sequence[str], base: Path, *packages: Path) -> None:
        self.words, self.base, self.folder = words, base, base / "run"
        self.paths = os.pathsep.join(map(str, (ROOT, *packages)))
        self.killed = base / "killed"

    def output(self) -> str:
        return (self.base / "output.txt").read_text(encoding="utf-8")

    def __call__(self, kill: str = "") -> int:
        """Exit code; every process has ended in time after the one that `kill` names (`tests/killed.py`)."""
        begun = status(self.folder) is not None
        words = [f"resume={self.folder}"] if begun else [*self.words, f"hydra.run.dir={self.folder}"]
        more = {"KILL": kill, "KILLED": str(self.killed), "FRAMEWORK_CACHE": str(self.base / "cache")}
        self.killed.unlink(missing_ok=True)
        command = Command(
            [sys.executable, "-P", "-m", "tests.killed", *words], self.base, PYTHONPATH=self.paths, **more
        )
        if kill:
            until(lambda: self.killed.exists() or command.process.poll() is not None, 200)
            assert self.killed.exists(), self.output()
        seconds = command.seconds_until_gone(LOADED if kill else 200)
        assert seconds < math.inf, f"{kill}: a process was left"
        return command.process.wait()


def until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    """Wait until a condition holds."""
    start = time.monotonic()
    while not condition():
        assert time.monotonic() - start < seconds, "it never happened"
        time.sleep(0.02)


@pytest.mark.slow
def test_a_run_that_is_fitted_at_once_logs_every_number_once(tmp_path: Path) -> None:
    """The run may be killed during training, validation or test."""
    for name in ("whole", "killed"):
        (tmp_path / name).mkdir()
    whole, killed = (Lives(FOREST, tmp_path / name) for name in ("whole", "killed"))
    assert whole() == 0, whole.output()
    for moment in ("fitted", "logged", "tested"):
        assert killed(f"0|{moment}|SIGKILL") == -signal.SIGKILL
        assert status(killed.folder) == "KILLED"
    assert killed() == 0
    assert differences(killed.folder, whole.folder) == []
    names = [
        name
        for line in (killed.folder / "journal.jsonl").read_text(encoding="utf-8").splitlines()
        for name in json.loads(line).get("values", {})
    ]
    assert "validation/loss" in names
    assert len(names) == len(set(names))


@pytest.mark.parametrize(
    "how",
    [
        *("is killed", "is killed, and closed by two", "closes"),
        pytest.param("is the job of a sweep that is killed", marks=pytest.mark.slow),
    ],
)
def test_a_run_is_closed_whatever_becomes_of_its_process(how: str, tmp_path: Path) -> None:
    """A separate process closes the run; a job of a dead sweep is killed if it does not end by itself."""
    run = [sys.executable, "-c", RUN, str(tmp_path), how]
    words = [sys.executable, "-c", PARENT, RUN, str(tmp_path), how] if "sweep" in how else run
    command = Command(words, tmp_path)
    until((tmp_path / "ready").exists)
    if how != "closes":
        os.kill(command.process.pid, signal.SIGKILL)
    if "two" in how:
        while status(tmp_path) == "RUNNING":
            mark_dead(tmp_path)
    assert command.seconds_until_gone(LOADED) < math.inf
    assert status(tmp_path) == ("FINISHED" if how == "closes" else "KILLED")
    lines = [json.loads(line) for line in (tmp_path / "journal.jsonl").read_text("utf-8").splitlines()]
    assert [line.get("status") for line in lines] == [None] if how == "closes" else [None, "KILLED"]


@pytest.mark.slow
def test_a_killed_script_leaves_nothing_of_its_sweep(tmp_path: Path) -> None:
    """Even a job that ignores the request to end leaves no process."""
    app = App(tmp_path, fork=True)
    words = ["-m", "hydra/launcher=pool", "what=hold,stubborn", "hydra.launcher.jobs=2"]
    script = (
        "import sys; from pathlib import Path; from benchmarks import commands; "
        f"commands.ROOT = Path({str(tmp_path)!r}); commands.carry_out(sys.argv[1:])"
    )
    command = Command(
        [sys.executable, "-c", script, sys.executable, "app.py", *words, "hydra.launcher.fork=true"],
        tmp_path,
        **app.environment | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    app.until_ready(0, 1)
    os.kill(command.process.pid, signal.SIGKILL)
    assert command.seconds_until_gone(LOADED) < math.inf
    assert [app.record(number)["error"] for number in range(2)] == [
        "stopped by SIGTERM",
        "killed by SIGKILL, as the system does when memory runs out",
    ]


END_BY_THEMSELVES = {
    "commands.py": "within five minutes; only tests start them",
    "watch.py": "when the run's process has ended",
    "store_process.py": "with their input",
    "repository.py": "within seconds, in which they read one commit",
    "pictures.py": "with their input",
    "ray_guard.py": "when the command has ended",
    "slurm.py": "within seconds, in which SLURM answers",
}
"""Files that start other processes, and when those end."""


def test_every_process_that_the_framework_starts_ends_with_it() -> None:
    bound: dict[str, list[bool]] = {}
    for path in [*ROOT.glob("framework/**/*.py"), *ROOT.glob("hydra_plugins/**/*.py")]:
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(call, ast.Call) and ast.unparse(call.func) in (
                "subprocess.Popen",
                "subprocess.run",
            ):
                ends = any(word.arg == "preexec_fn" for word in call.keywords)
                bound.setdefault(path.name, []).append(ends)
    assert {"processes.py", "rehearsal.py", "rank_processes.py"} <= bound.keys()
    assert {name for name, ends in bound.items() if not all(ends)} <= END_BY_THEMSELVES.keys()
