"""Kill training, calibration, tests, encoding, predictions and sweeps at random moments, and compare their results.

    python -m tests.soak 200 --folder /tmp/soak [--minutes 4.5] [--only encoding]

The test kills a command up to eight times, lets it finish, and compares what it has written, to the last bit, with the
same command without a kill (`tests.fuzz.kills`). SLURM is included if its programs are on PATH. The folder keeps the
counts, so that the command can be stopped (SIGINT, SIGTERM) and repeated. Each kind of kill has a share of all kills,
and the kind that has made the smallest part of its share comes next. benchmarks/framework/soak.json holds the kills of
all tests so far, which count as well. The script writes soak.json and soak.md there: when all kills are made (unless
--only chose some kinds), or at its end if --page is given.
"""

import argparse
import datetime
import json
import math
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

from benchmarks.pages import environment, write_page
from framework.storage.files import hold_lock, write_whole
from tests.fuzz.kills import ALLOWED, MARK, ROOT, RUN, Kind, Moments, Tally, killed, start
from tests.slurm_cluster import SlurmCluster, missing_programs
from tests.soak.events import EVENTS
from tests.soak.kinds import Soaked, all_kinds, prepare

RECORD = ROOT / "benchmarks/framework/soak.json"
"""File with the counts of all soak tests so far, from which the page is written."""
LEFT = 60.0
"""Seconds that must be left of --minutes for another command to start."""
IN_A_ROW = 8
"""Largest number of kills of one run or sweep."""
TIMES = 3
"""Number of repetitions of each event among 200 kills."""


EVENT_ROWS = (
    "In three kinds of event more happens than the kill of a single command:",
    "",
    "- *Two sweeps*: they share a folder and a job. The first sweep is killed and repeated. Every job must exist once, "
    "with the results of an undisturbed job.",
    "- *The store and the run*: the server of the store is killed, then the run. The run is resumed, and the server "
    "starts again. Every number of the journal must be in the store once.",
    "- *The tables of the thesis*: the script that makes them is killed while it runs a sweep. None of its processes "
    "may be left 10 s later.",
    "",
    "| event | repetitions | kills | with a fault |",
    "|---|---:|---:|---:|",
)
"""Text and head of the table of events on the page."""


@dataclass
class Counts:
    """Counts of one soak test, or of several.

    Attributes:
        began: Time of the first start, in ISO format; it identifies the test.
        machine: Processor, date and versions.
        commits: Names of the commits that were tested, as `git describe` writes them.
        tallies: Counts by kind and number of the signal.
        events: Number of repetitions, of kills and of faults of each event.
        faults: What was lost or different.
    """

    began: str = ""
    machine: str = ""
    commits: list[str] = field(default_factory=list)
    tallies: dict[str, dict[int, Tally]] = field(default_factory=dict)
    events: dict[str, list[int]] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)

    @classmethod
    def parse(cls, values: dict[str, Any]) -> Self:
        """Return the counts that `asdict` has turned into plain values."""
        tallies = {
            name: {int(number): Tally(**tally) for number, tally in by_signal.items()}
            for name, by_signal in values["tallies"].items()
        }
        return cls(**{**values, "tallies": tallies})

    def kills(self, name: str) -> int:
        """Return the number of kills of one kind."""
        return sum(tally.kills for tally in self.tallies.get(name, {}).values())

    def repetitions(self, name: str) -> int:
        """Return the number of repetitions of one event."""
        return self.events.get(name, [0])[0]

    @property
    def total(self) -> int:
        """Return the number of all kills."""
        return sum(map(self.kills, self.tallies)) + sum(kills for _, kills, _ in self.events.values())

    def add(self, other: "Counts") -> None:
        """Add the counts of another test."""
        for name, by_signal in other.tallies.items():
            for number, tally in by_signal.items():
                self.tallies.setdefault(name, {}).setdefault(number, Tally()).add(tally)
        for name, numbers in other.events.items():
            self.events[name] = [
                own + more for own, more in zip(self.events.get(name, [0, 0, 0]), numbers, strict=True)
            ]
        self.faults += other.faults


@dataclass
class State(Counts):
    """Counts of the soak test in a folder, and what the test needs to go on.

    Attributes:
        durations: Seconds of each command without a kill.
        references: Names of the commits of these commands.
        paces: Factors for these seconds, by kind; below 1 if commands finish before a kill.
        attempts: Number of commands that were killed, by kind.
    """

    durations: dict[str, float] = field(default_factory=dict)
    references: dict[str, str] = field(default_factory=dict)
    paces: dict[str, float] = field(default_factory=dict)
    attempts: dict[str, int] = field(default_factory=dict)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Return the state in a file, or an empty one."""
        if path.is_file():
            return cls.parse(json.loads(path.read_text(encoding="utf-8")))
        return cls(began=datetime.datetime.now().isoformat(timespec="seconds"))

    def counts(self) -> Counts:
        """Return the counts without the rest of the state."""
        return Counts(self.began, self.machine, self.commits, self.tallies, self.events, self.faults)


def read_tests(path: Path) -> list[Counts]:
    """Return the counts of all soak tests in a file; the list is empty without the file."""
    return [Counts.parse(values) for values in json.loads(path.read_text("utf-8"))] if path.is_file() else []


class Soak:
    """Soak test whose state is in a folder.

    Args:
        folder: Folder for the state, the inputs, and the runs of commands that are not killed.
        count: Number of kills.
    """

    def __init__(self, folder: Path, count: int) -> None:
        self.folder = folder
        self.count = count
        folder.mkdir(parents=True, exist_ok=True)
        self.state = State.load(folder / "state.json")
        self.earlier = [counts for counts in read_tests(RECORD) if counts.began != self.state.began]
        if not (folder / "inputs").is_dir():
            partial = folder / "inputs.partial"
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir()
            prepare(partial)
            partial.rename(folder / "inputs")

    def kill(self, soaked: Soaked, most: int = IN_A_ROW) -> list[str]:
        """Kill a command a few times, and return what differs from the reference command without a kill."""
        kind, name = soaked.kind, soaked.kind.name
        reference = soaked.reference or kind
        whole = self.whole(reference)
        number = self.state.attempts[name] = self.state.attempts.get(name, 0) + 1
        tallies = self.state.tallies.setdefault(name, {})
        draw = random.Random(f"{self.state.began} {name} {number}")
        folder = self._empty(f"{_slug(name)}-{number}")
        before = self.state.kills(name)
        pace = self.state.paces.get(name, 1.0)
        moments = Moments.measured(reference, whole, self.state.durations[reference.name], pace)
        faults = killed(kind, folder, whole, moments, most, draw, tallies)
        if self.state.kills(name) < before + most:  # it finished before a kill
            self.state.paces[name] = pace / 2
        self._note(name, number, faults, folder)
        return faults

    def happen(self, name: str) -> list[str]:
        """Let an event happen once, and return what was lost or differs."""
        reference = Kind("event: one run", RUN, lambda command: [])
        if EVENTS[name].__name__ == "two_sweeps":
            words = ("-m", *RUN, "seed=0,1,2", "hydra.launcher.fork=true")
            reference = Kind("event: one sweep", words, lambda command: [], sweep=True)
        whole = self.whole(reference)
        repetitions, kills, bad = self.state.events.get(name, [0, 0, 0])
        folder = self._empty(f"{_slug(name)}-{repetitions}")
        draw = random.Random(f"{self.state.began} {name} {repetitions}")
        kill_count, faults = EVENTS[name](folder, whole, draw, self.state.durations[reference.name])
        self.state.events[name] = [repetitions + 1, kills + kill_count, bad + bool(faults)]
        self._note(name, repetitions, faults, folder)
        return faults

    def whole(self, kind: Kind) -> Path:
        """Return the folder of the command's run without a kill, which is made once for each commit of the project."""
        commit = _commit()
        whole = self.folder / "whole" / _slug(kind.name) / "it"
        if self.state.references.get(kind.name) != commit:
            shutil.rmtree(whole.parent, ignore_errors=True)
            whole.parent.mkdir(parents=True)
            began = time.monotonic()
            command = start(kind, whole)
            if command.process.wait(timeout=600):
                raise RuntimeError(f"{kind.name} failed: {command.output}")
            self.state.durations[kind.name] = time.monotonic() - began
            self.state.paces.pop(kind.name, None)
            self.state.references[kind.name] = commit
            self._save()
        return whole

    @property
    def counts(self) -> Counts:
        """Return the counts of this test and of all earlier tests together."""
        together = Counts()
        for counts in (*self.earlier, self.state):
            together.add(counts)
        return together

    def _empty(self, name: str) -> Path:
        """Return a folder that does not exist; a test that was stopped may have left it."""
        folder = self.folder / "runs" / name
        shutil.rmtree(folder, ignore_errors=True)
        return folder

    def _save(self) -> None:
        write_whole(self.folder / "state.json", json.dumps(asdict(self.state), indent=1).encode())

    def _note(self, name: str, number: int, faults: list[str], folder: Path) -> None:
        commit = _commit()
        if commit not in self.state.commits:
            self.state.commits.append(commit)
        self.state.machine = environment("torch", "pytorch-lightning", "hydra-core", "mlflow", "ray")
        self.state.faults += [f"{name} {number}: {fault}" for fault in faults[:5]]
        self._save()
        if not faults:
            shutil.rmtree(folder, ignore_errors=True)

    def run(self, kinds: list[Soaked], events: list[str], deadline: float) -> bool:
        """Kill until every kind has its share, or until `deadline` (`time.monotonic`); return whether all is done."""
        wanted = {soaked.kind.name: -(-soaked.weight * self.count // 200) for soaked in kinds}
        repetitions = -(-TIMES * self.count // 200)
        broken = set[str]()
        while time.monotonic() < deadline - LEFT:
            counts = self.counts
            left = {
                soaked.kind.name: soaked
                for soaked in kinds
                if counts.kills(soaked.kind.name) < wanted[soaked.kind.name]
            }
            due = [name for name in events if counts.repetitions(name) < repetitions]
            names = [name for name in (*left, *due) if name not in broken]
            if not names:
                return not (left or due)
            shares = {name: counts.kills(name) / wanted[name] for name in left}
            shares |= {name: counts.repetitions(name) / repetitions for name in due}
            name = min(names, key=shares.__getitem__)
            try:
                if name in left:
                    faults = self.kill(left[name], min(IN_A_ROW, wanted[name] - counts.kills(name)))
                else:
                    faults = self.happen(name)
            except (RuntimeError, ValueError, OSError, subprocess.SubprocessError) as error:
                broken.add(name)
                end_all(self.folder)
                faults = [f"{type(error).__name__}: {error}"]
                self._note(name, -1, faults, self.folder)
            sys.stdout.write(f"{self.counts.total} kills; {name}: {faults[:5] or 'equal'}\n")
            sys.stdout.flush()
        return False


def end_all(folder: Path) -> None:
    """Kill the processes of commands that work in a folder, after one of them has failed or the test was stopped."""
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # the process has ended
            ours = f"{MARK}=".encode() in (process / "environ").read_bytes()
            if ours and (process / "cwd").readlink().is_relative_to(folder):
                os.kill(int(process.name), signal.SIGKILL)


def _commit() -> str:
    """Return the name of the project's commit; it ends with "-dirty" if files were changed since."""
    describe = ("git", "describe", "--always", "--dirty", "--exclude=*")
    return subprocess.run(describe, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def _slug(name: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in name)


@contextmanager
def slurm_cluster() -> Iterator[SlurmCluster | None]:
    """Run SLURM on this machine during the block, if its programs are on PATH."""
    if missing_programs():
        yield None
        return
    with tempfile.TemporaryDirectory(prefix="slurm") as folder:  # a short path, because it holds sockets
        cluster = SlurmCluster(Path(folder))
        try:
            yield cluster
        finally:
            cluster.close()


RAY_NOTE = (
    "- *inf s*: after one of the first kills of a sweep on Ray, a process was alive for more than 30 s. The test did "
    "not record which process. If the command is killed while Ray starts, the two agents of Ray's node "
    "(`dashboard/agent.py` and `runtime_env/agent/main.py`) notice it only after their own start. Of six kills at such "
    "moments, three left these agents for 15, 17 and 80 s on a busy machine, and no other process. Since then, "
    "`framework.sweeps.ray_guard` ends them: after three kills at the same moments, all processes had ended within 7 s."
)
"""Line of the page on processes that Ray left."""


STORE_NOTE = (
    "In the fault of *the store and the run* (commit e3891c10), the test killed MLflow's server while the server "
    "created its SQLite database. MLflow could not repair this database (`duplicate column name: run_link`), so "
    "`mode=sync` said that the store did not accept the numbers. The journal of the run held all of them; journal and"
    " weights equalled those of an undisturbed run. Since then, the test waits until the server has created its "
    "database. The stores that the framework itself creates are complete before they have their name."
)
"""Paragraph of the page on the fault in which MLflow's own database was incomplete."""


COMMIT_NOTE = (
    "Four kills of jobs with a table (commit dd7d5cf4) were first compared with an undisturbed command of an older "
    "commit, which fits temperatures differently, and the temperatures and likelihoods differed. An undisturbed "
    "command of commit dd7d5cf4 gave the same weights and numbers as the killed ones, so these kills count as "
    "equal. Since commit 1ad97d7d, the test repeats the undisturbed commands at each new commit."
)
"""Paragraph of the page on results that were compared with those of an older commit."""


def page(soak: Soak, kinds: list[Soaked]) -> str:
    """Return the page of a soak test."""
    counts = soak.counts
    rows = []
    for soaked in kinds:
        for number, tally in sorted(counts.tallies.get(soaked.kind.name, {}).items()):
            ended = "they go on" if soaked.kind.outlives else f"{tally.ended} ({tally.slowest:.1f} s)"
            closed = "–" if soaked.kind.outlives else str(tally.closed)
            rows.append(
                f"| {soaked.kind.name} | {signal.Signals(number).name} | {tally.kills} | {ended} | {closed} | "
                f"{tally.same} |"
            )
    events = [
        f"| {name} | {repetitions} | {kills} | {bad} |"
        for name, (repetitions, kills, bad) in counts.events.items()
    ]
    missing = [soaked.kind.name for soaked in kinds if not counts.kills(soaked.kind.name)]
    missing += [name for name in EVENTS if name not in counts.events]
    tallies = [tally for by_signal in counts.tallies.values() for tally in by_signal.values()]
    tests = [test for test in (*soak.earlier, soak.state) if test.total]
    coverage = (
        "The test has not yet killed the following commands and processes (each item names a command and, after a "
        f"comma, the process that is killed): {'; '.join(missing)}."
        if missing
        else "Each kind of command and process in the test has been killed."
    )
    return "\n".join(
        [
            "# Soak test",
            "",
            "This page says whether anything is lost or different after kills at random moments. The test has "
            f"killed {counts.total} commands, or single processes of commands. Each command was killed at most "
            "eight times, and was then repeated without a kill until it finished. The test is made by `python -m "
            f"tests.soak {soak.count} --folder <folder>`, which is repeated until all kills are made. It adds its "
            "kills to those of earlier tests, which `soak.json` holds. The end of the page lists the tests.",
            "",
            coverage,
            "",
            f"- *all ended*: no process of the command was alive {ALLOWED:.0f} s after the kill; the longest time is "
            "in brackets. If a job, a fork server or a worker is killed, the command goes on and starts the job "
            "again. Jobs on SLURM go on without the command that has submitted them, and the repeated command "
            "takes them up again.",
            "- *closed*: afterwards, no `run.json` has the status RUNNING.",
            "- *equal*: after the command was repeated, weights, journal, results, predictions and features equal "
            "those of the same command without a kill, to the last bit; costs are not compared. If jobs and workers on "
            "Ray and SLURM are killed, the results are compared with those of the same sweep on the pool.",
            "- *the clock goes back*: in this kind of test, Python's clock is set back by one hour at each start "
            "of a process, and by one more hour every 2 s.",
            *([RAY_NOTE] if any(math.isinf(tally.slowest) for tally in tallies) else ()),
            "",
            "| killed | signal | kills | all ended | closed | equal |",
            "|---|---|---:|---:|---:|---:|",
            *rows,
            "",
            *([*EVENT_ROWS, *events, ""] if events else ()),
            f"Faults: {'; '.join(counts.faults) or 'none'}.",
            "",
            *([STORE_NOTE, ""] if counts.events.get("the store and the run", [0, 0, 0])[2] else ()),
            COMMIT_NOTE,
            "",
            "The tests so far:",
            "",
            *(
                f"- {test.total} kills at the commits {', '.join(test.commits)}, on {test.machine}"
                for test in tests
            ),
            "",
        ]
    )


def main() -> None:
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument("count", type=int, help="number of kills")
    arguments.add_argument("--folder", type=Path, required=True, help="folder of the state and the runs")
    arguments.add_argument("--minutes", type=float, default=1e6, help="time after which the test stops")
    arguments.add_argument(
        "--only", default="", help="kill only commands whose name contains this regular expression"
    )
    arguments.add_argument("--page", action="store_true", help="write the page before all kills are made")
    options = arguments.parse_args()
    deadline = time.monotonic() + 60 * options.minutes
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    os.environ.setdefault("FRAMEWORK_CACHE", str(options.folder.absolute() / "cache"))
    options.folder.mkdir(parents=True, exist_ok=True)
    with hold_lock(options.folder / ".lock"), slurm_cluster() as slurm, ExitStack() as at_the_end:
        at_the_end.callback(end_all, options.folder.absolute())
        soak = Soak(options.folder.absolute(), options.count)
        kinds = all_kinds(soak.folder / "inputs", {} if slurm is None else slurm.environment)
        chosen = [
            soaked
            for soaked in kinds
            if re.search(options.only, soaked.kind.name) and (slurm is not None or soaked.engine != "slurm")
        ]
        complete = soak.run(chosen, [name for name in EVENTS if re.search(options.only, name)], deadline)
    if options.page or (complete and not options.only):
        tests = [asdict(counts) for counts in (*soak.earlier, soak.state.counts())]
        write_whole(RECORD, (json.dumps(tests, indent=1) + "\n").encode())
        write_page(RECORD, page(soak, kinds))


if __name__ == "__main__":
    main()
