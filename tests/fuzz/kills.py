"""Kill ranks, sweeps and fork servers at random moments, and compare the resumed results.

    python -m tests.fuzz.kills

The script kills a run or sweep a few times, resumes it after each kill, and lets it finish. Then it compares the
checkpoints and journals, to the last bit, with those of the same command without a kill. It writes kills.md beside this
file.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import torch

from benchmarks.pages import machine, write_page

ROOT = Path(__file__).resolve().parents[2]
ALLOWED = 10.0
"""Time within which every process has to end, seconds."""
IN_A_ROW = 4
"""Largest number of kills of one run or sweep."""
MARK = "FRAMEWORK_KILLS"
"""Environment variable that marks the processes of a command, also those whose parents have ended."""
RUN = (
    "experiment=moons/vanilla_128",
    "trainer.max_epochs=200",
    "trainer.log_every_steps=1",
    "trainer.checkpoint_every_steps=20",
    "trainer.check_val_every_n_epoch=10",
    "threads=1",
    "logger=none",
    "pictures=false",
)
RANKS = ("trainer=ddp", "trainer.devices=2", "trainer.accelerator=cpu")
SCRIPT = "import sys; from benchmarks.commands import carry_out; carry_out(sys.argv[1:])"
"""Script that runs a command in the same way as `thesis_tables.py` runs its sweeps."""


@dataclass(frozen=True)
class Process:
    """A process of a command, as /proc shows it."""

    number: int
    parent: int
    command: tuple[str, ...]
    rank: str


class Command:
    """Running command of the framework, with all processes that it has started.

    Args:
        words: arguments of the command.
        folder: working directory; the output goes to `output.txt` in this folder.
        more: further environment variables.
    """

    def __init__(self, words: Sequence[str], folder: Path, **more: str) -> None:
        self.mark = uuid.uuid4().hex
        self.output = folder / "output.txt"
        environment = {**os.environ, "OMP_NUM_THREADS": "1", **more, MARK: self.mark}
        with self.output.open("ab") as output:
            self.process = subprocess.Popen(
                words, cwd=folder, env=environment, stdout=output, stderr=output, start_new_session=True
            )

    def alive(self) -> list[Process]:
        """Return the processes of the command that have not ended."""
        self.process.poll()
        entry, found = f"{MARK}={self.mark}".encode(), []
        for place in Path("/proc").iterdir():
            if not place.name.isdigit():
                continue
            with suppress(OSError):  # it has ended
                own = (place / "environ").read_bytes().split(b"\0")
                state = (place / "stat").read_text(errors="replace").rpartition(")")[2].split()
                if entry not in own or state[0] in "ZX":
                    continue
                words = (place / "cmdline").read_bytes().decode(errors="replace").split("\0")
                rank = next((one[11:].decode() for one in own if one.startswith(b"LOCAL_RANK=")), "0")
                found.append(Process(int(place.name), int(state[1]), tuple(words), rank))
        return found

    def seconds_until_gone(self, patience: float, some: Set[int] | None = None) -> float:
        """Wait until no process of the command (or none of `some`) is alive, and return the seconds. After
        `patience` seconds the remaining processes are killed and the result is infinite."""
        start = time.monotonic()
        while alive := [one for one in self.alive() if some is None or one.number in some]:
            if time.monotonic() - start > patience:
                for process in alive:
                    with suppress(ProcessLookupError):
                        os.kill(process.number, signal.SIGKILL)
                return float("inf")
            time.sleep(0.05)
        if some is None:
            self.process.wait(patience)  # its environment is gone before it has ended
        return time.monotonic() - start


def numbers(run: Path) -> dict[tuple[str, int], str]:
    """Return the numbers in the journal of a run by name and step, without its costs.

    Raises:
        ValueError: the journal holds a number of one step twice.
    """
    found: dict[tuple[str, int], str] = {}
    for line in (run / "journal.jsonl").read_text(encoding="utf-8").splitlines():
        record = json.loads(line)
        for name, value in record.get("values", {}).items():
            if name.startswith("cost/"):
                continue
            if (name, record["step"]) in found and not name.startswith("test/"):
                raise ValueError(f"{name} of step {record['step']} stands twice in {run}")
            found[name, record["step"]] = repr(value)
    return found


def differences(run: Path, whole: Path) -> list[str]:
    """Return the names of tensors and numbers in which two runs differ; the list is empty if all bits are equal."""
    states: list[dict[str, Any]] = [
        torch.load(one / "checkpoints" / "model.ckpt", weights_only=True)["state_dict"]
        for one in (run, whole)
    ]
    found = [] if states[0].keys() == states[1].keys() else ["names of tensors"]
    found += [
        key
        for key, tensor in states[1].items()
        if key in states[0] and not torch.equal(tensor, states[0][key])
    ]
    own, wanted = numbers(run), numbers(whole)
    return found + [f"{name} of step {step}" for name, step in own.keys() ^ wanted.keys()] + [
        f"{name} of step {step}" for name, step in own.keys() & wanted.keys() if own[name, step] != wanted[name, step]
    ]  # fmt: skip


def status(run: Path) -> str | None:
    """Return the status in run.json, or None before the run was opened."""
    path = run / "run.json"
    return json.loads(path.read_text(encoding="utf-8"))["status"] if path.is_file() else None


Choose = Callable[[Command], list[int]]
"""Function from a running command to the ids of the processes that may be killed now."""


def first(command: Command) -> list[int]:
    return [command.process.pid]


def rank(number: int) -> Choose:
    """Choose the process of a rank, without the processes that load its data or watch it."""

    def chosen(command: Command) -> list[int]:
        found = [
            one
            for one in command.alive()
            if one.rank == str(number) and {"framework", "framework.__main__"} & {*one.command}
        ]
        inner = {one.number for one in found}
        return [one.number for one in found if number or one.parent not in inner]

    return chosen


def fork_server(command: Command) -> list[int]:
    """Choose the fork server, once it has forked a job."""
    forks = [one for one in command.alive() if "framework.sweeps.fork_server" in one.command]
    numbers = {one.number for one in forks}
    return sorted({one.parent for one in forks} & numbers)


@dataclass(frozen=True)
class Kind:
    """Kind of process to kill, and the command in which it runs.

    Attributes:
        name: name in the page.
        words: arguments of the command, without its folder.
        choose: function that chooses the process to kill.
        numbers: signals to send, one after the other.
        sweep: whether the command is a sweep.
        script: whether a script runs the command, as `thesis_tables.py` does.
        goes_on: whether the command itself must complete, and only the children of the killed process end.
        outlives: whether the jobs go on when the command is killed, so that the next command takes them up again.
        environment: further environment variables.
        compare: function that returns the names of what differs between a run and the run without a kill.
    """

    name: str
    words: tuple[str, ...]
    choose: Choose
    numbers: tuple[signal.Signals, ...] = (signal.SIGKILL,)
    sweep: bool = False
    script: bool = False
    goes_on: bool = False
    outlives: bool = False
    environment: Mapping[str, str] = field(default_factory=dict)
    compare: Callable[[Path, Path], list[str]] = differences

    def command(self, folder: Path) -> list[str]:
        """Return the command of a run or sweep in `folder`, whose name replaces "{folder}" in the words."""
        where = f"hydra.{'sweep' if self.sweep else 'run'}.dir={folder}"
        words = (word.replace("{folder}", str(folder)) for word in self.words)
        words = [sys.executable, "-P", "-m", "framework", *words, where]
        return [sys.executable, "-c", SCRIPT, *words] if self.script else words


def sweep(name: str, choose: Choose, *words: str, seeds: int = 3, **more: Any) -> Kind:
    drawn = ",".join(map(str, range(seeds)))
    return Kind(
        name, ("-m", *RUN, f"seed={drawn}", "hydra.launcher.jobs=2", *words), choose, sweep=True, **more
    )


BOTH = (signal.SIGKILL, signal.SIGTERM)
KINDS = (
    Kind("rank 0 of two", (*RUN, *RANKS), rank(0), BOTH),
    Kind("rank 1 of two", (*RUN, *RANKS), rank(1), BOTH),
    sweep("a sweep, jobs are forks", first, "hydra.launcher.fork=true"),
    sweep("a sweep, jobs are processes of their own", first, "hydra.launcher.fork=false", seeds=2),
    sweep("a sweep, jobs have two data-loading processes", first, "workers=2", seeds=2),
    sweep("a sweep, its job has two ranks", first, *RANKS, "hydra.launcher.fork=true", seeds=1),
    sweep("the process whose forks are jobs", fork_server, "hydra.launcher.fork=true", goes_on=True),
    sweep("a script that runs a sweep", first, "hydra.launcher.fork=true", seeds=2, script=True),
)  # fmt: skip


@dataclass
class Tally:
    """Counts of the outcomes of all kills of one kind with one signal."""

    kills: int = 0
    ended: int = 0
    slowest: float = 0.0
    closed: int = 0
    same: int = 0

    def add(self, other: "Tally") -> None:
        """Add the counts of further kills."""
        self.kills += other.kills
        self.ended += other.ended
        self.slowest = max(self.slowest, other.slowest)
        self.closed += other.closed
        self.same += other.same


def runs(kind: Kind, folder: Path) -> list[Path]:
    return sorted(path.parent for path in folder.glob("*/job.json")) if kind.sweep else [folder]


def shortest_job(kind: Kind, folder: Path) -> float:
    """Return the seconds of the shortest job of a sweep; 0 for a command that is not a sweep."""
    records = [json.loads((run / "job.json").read_text("utf-8")) for run in runs(kind, folder) if kind.sweep]
    return min((record["ended"] - record["started"] for record in records), default=0.0)


@dataclass(frozen=True)
class Moments:
    """Times from which the moments of kills are drawn, and the time after which a command counts as hanging.

    Attributes:
        command: Seconds of the command without a kill.
        job: Seconds of the shortest job of a sweep without a kill; 0 for a command that is not a sweep.
        patience: Seconds after which a command counts as hanging.
    """

    command: float
    job: float
    patience: float

    @classmethod
    def measured(cls, kind: Kind, whole: Path, seconds: float, pace: float = 1.0) -> Self:
        """Return the times for a command that took `seconds` without a kill.

        Args:
            kind: Kind of the command.
            whole: Folder of the run or sweep without a kill.
            seconds: Seconds that the command took without a kill.
            pace: Factor for both times, below 1 if the machine is less busy now.
        """
        return cls(pace * seconds, pace * shortest_job(kind, whole), 20 * seconds)


def start(kind: Kind, run: Path) -> Command:
    """Start the command of a run or sweep in the folder `run`; its output goes to the folder above."""
    return Command(kind.command(run), run.parent, **{"PYTHONPATH": str(ROOT), **kind.environment})


def killed(
    kind: Kind, folder: Path, whole: Path, moments: Moments, kills: int, draw: random.Random, tallies: dict[int, Tally]
) -> list[str]:  # fmt: skip
    """Kill one run or sweep `kills` times, let it finish, and compare it with the run that was not killed.

    The moments of the kills are drawn from the duration of the command or, if the command goes on, from that of a job.

    Returns:
        Names of what differs, and of runs that have not finished.
    """
    folder.mkdir(parents=True)
    done: list[int] = []
    command: Command | None = None
    while len(done) < kills:
        number = kind.numbers[sum(tally.kills for tally in tallies.values()) % len(kind.numbers)]
        share = draw.uniform(0.1, 0.9) if command is None else draw.uniform(0.05, 0.3)
        deadline = time.monotonic() + share * moments.command
        command = command or start(kind, folder / "it")
        if kind.goes_on:
            while command.process.poll() is None and not kind.choose(command):
                time.sleep(0.05)
            deadline = time.monotonic() + draw.uniform(0.0, 0.4) * moments.job
        while command.process.poll() is None and (
            time.monotonic() < deadline or not (victims := kind.choose(command))
        ):
            time.sleep(0.01)
        if command.process.poll() is not None:
            if all(status(run) == "FINISHED" for run in runs(kind, folder / "it")):
                break  # the command finished before the kill; earlier kills count
            if not (kind.goes_on and done):
                raise RuntimeError(f"{kind.name} ended by itself: {command.output}")
            command = None
            continue
        victim = draw.choice(victims)
        some = {victim, *(process.number for process in command.alive() if process.parent == victim)}
        with suppress(ProcessLookupError):
            os.kill(victim, number)
        tally = tallies.setdefault(number, Tally())
        tally.kills += 1
        done.append(number)
        if kind.outlives:
            command.process.wait()
            command = None
            continue
        seconds = command.seconds_until_gone(3 * ALLOWED, some if kind.goes_on else None)
        tally.ended += seconds <= ALLOWED
        tally.slowest = max(tally.slowest, seconds)
        if not kind.goes_on:
            tally.closed += all(status(run) != "RUNNING" for run in runs(kind, folder / "it"))
            command = None
    if kind.goes_on and command is not None:
        command.process.wait(timeout=moments.patience)
        closed = all(status(run) != "RUNNING" for run in runs(kind, folder / "it"))
        for number in done:
            tallies[number].closed += closed
    start(kind, folder / "it").process.wait(timeout=moments.patience)
    wanted = [run.relative_to(whole) for run in runs(kind, whole)]
    faults = [
        difference
        for name in wanted
        for difference in (
            kind.compare(folder / "it" / name, whole / name)
            if status(folder / "it" / name) == "FINISHED"
            else [f"the status {status(folder / 'it' / name)} of {name}"]
        )
    ]
    if (count := len(runs(kind, folder / "it"))) != len(wanted):
        faults.append(f"{count} jobs, not {len(wanted)}")
    for number in done:
        tallies[number].same += not faults
    if faults:
        sys.stderr.write(f"{kind.name}: {folder} differs: {faults[:5]}\n")
    return faults


def measure(kind: Kind, kills: int, draw: random.Random, base: Path) -> list[str]:
    """Kill commands of one kind, and return the lines of the page."""
    whole = base / "whole" / "it"
    whole.parent.mkdir(parents=True)
    began = time.monotonic()
    code = start(kind, whole).process.wait(timeout=600)
    moments = Moments.measured(kind, whole, time.monotonic() - began)
    if code:
        raise RuntimeError(f"{kind.name} failed: {whole.parent / 'output.txt'}")
    tallies: dict[int, Tally] = {}
    for attempt in range(2 * kills):
        left = kills - sum(tally.kills for tally in tallies.values())
        if left <= 0:
            break
        killed(kind, base / str(attempt), whole, moments, min(left, IN_A_ROW), draw, tallies)
    return [
        f"| {kind.name} | {signal.Signals(number).name} | {tally.kills} | {tally.ended} ({tally.slowest:.1f} s) | "
        f"{tally.closed} | {tally.same} |"
        for number, tally in sorted(tallies.items())
    ]


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument(
        "--kills", type=int, default=4, help="number of kills of each kind with each of its signals"
    )
    arguments.add_argument("--seed", type=int, default=0)
    given = arguments.parse_args()
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        for index, kind in enumerate(KINDS):
            draw = random.Random(given.seed * 1000 + index)
            lines += measure(kind, given.kills * len(kind.numbers), draw, Path(folder) / str(index))
            sys.stdout.write("\n".join(lines) + "\n")
            sys.stdout.flush()
    write_page(__file__, page(lines, given.kills, given.seed))


def page(lines: Sequence[str], kills: int, seed: int) -> str:
    return "\n".join(
        [
            "# Killed ranks, sweeps and fork servers",
            "",
            f"The numbers were measured by `python -m tests.fuzz.kills --kills {kills} --seed {seed}`. Each kill comes "
            f"at a random moment after the start of the command. After at most {IN_A_ROW} kills, the resumed run or "
            "sweep is left to finish.",
            "",
            f"- *all ended*: no process of the command is alive {ALLOWED:.0f} s after the kill; the longest time is in "
            "brackets. If only the process whose forks are jobs is killed, the sweep continues, and the column counts "
            "the jobs that were forks of that process.",
            "- *closed*: afterwards, no `run.json` has the status RUNNING.",
            "- *resumed bit-equal*: the weights of every checkpoint and every number of every journal equal those of "
            "the same command without a kill.",
            "",
            f"The commands are runs of `{' '.join(RUN)}`. Ranks are tested with `{' '.join(RANKS)}`.",
            "",
            "| killed | signal | kills | all ended | closed | resumed bit-equal |",
            "|---|---|---:|---:|---:|---:|",
            *lines,
            "",
            f"{machine('torch', 'pytorch-lightning', 'hydra-core')} The load average at the end was "
            f"{os.getloadavg()[2]:.0f}.",
            "",
        ]
    )


if __name__ == "__main__":
    main()
