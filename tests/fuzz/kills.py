"""Kill ranks, sweeps and fork servers at random moments, and compare what resumes.

    python -m tests.fuzz.kills

A run or a sweep is killed a few times, goes on after each, and ends; its checkpoints and journals are then compared, to
the last bit, with those of one that nobody killed. Writes kills.md beside this file.
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
from collections.abc import Callable, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from benchmarks.pages import machine, write_page

ROOT = Path(__file__).resolve().parents[2]
ALLOWED = 10.0
"""Seconds within which every process has to end."""
IN_A_ROW = 4
"""Kills of one run or sweep, most."""
MARK = "FRAMEWORK_KILLS"
"""Environment variable by which the processes of a command are found, whatever has become of their parents."""
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
"""What thesis_tables.py does with each of its sweeps."""


@dataclass(frozen=True)
class Process:
    """A process of a command, as /proc shows it."""

    number: int
    parent: int
    command: tuple[str, ...]
    rank: str


class Command:
    """A command of the framework that runs, with all processes that come of it.

    Args:
        words: of the command.
        folder: working directory; its output goes to `output.txt` there.
        more: further environment.
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
        """Those of its processes that have not ended."""
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
        """Seconds until none (of some) is alive; infinite where one is after so many, which then are killed."""
        start = time.monotonic()
        while alive := [one for one in self.alive() if some is None or one.number in some]:
            if time.monotonic() - start > patience:
                for process in alive:
                    with suppress(ProcessLookupError):
                        os.kill(process.number, signal.SIGKILL)
                return float("inf")
            time.sleep(0.05)
        self.process.poll()
        return time.monotonic() - start


def numbers(run: Path) -> dict[tuple[str, int], str]:
    """The numbers of a run by name and step, but for its costs.

    Raises:
        ValueError: one of a step stands there twice.
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
    """In what a run's checkpoint and journal differ from another's; nothing where all bits are the same."""
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
    """What run.json says; None before the run was opened."""
    path = run / "run.json"
    return json.loads(path.read_text(encoding="utf-8"))["status"] if path.is_file() else None


Choose = Callable[[Command], list[int]]
"""From a command to the processes that may be killed now."""


def first(command: Command) -> list[int]:
    return [command.process.pid]


def rank(number: int) -> Choose:
    """Of a training with several processes; not what loads data for it, or watches it."""

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
    """Once it has forked."""
    forks = [one for one in command.alive() if "framework.sweeps.fork_server" in one.command]
    numbers = {one.number for one in forks}
    return sorted({one.parent for one in forks} & numbers)


@dataclass(frozen=True)
class Kind:
    """What is killed.

    Attributes:
        name: for the page.
        words: of the command, but for the folder.
        choose: the process to kill.
        numbers: signals, in turns.
        sweep: whether the command is a sweep.
        script: whether the command runs in a script as `thesis_tables.py`.
        goes_on: whether the command itself is to end as ever, and only children of what is killed are not.
    """

    name: str
    words: tuple[str, ...]
    choose: Choose
    numbers: tuple[signal.Signals, ...] = (signal.SIGKILL,)
    sweep: bool = False
    script: bool = False
    goes_on: bool = False

    def command(self, folder: Path) -> list[str]:
        where = f"hydra.{'sweep' if self.sweep else 'run'}.dir={folder}"
        words = [sys.executable, "-P", "-m", "framework", *self.words, where]
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
    """What became of the kills of a kind with one signal."""

    kills: int = 0
    ended: int = 0
    slowest: float = 0.0
    closed: int = 0
    same: int = 0


def runs(kind: Kind, folder: Path) -> list[Path]:
    return sorted(path.parent for path in folder.glob("*/job.json")) if kind.sweep else [folder]


def killed(
    kind: Kind, folder: Path, whole: Path, duration: float, kills: int, draw: random.Random, tallies: dict[int, Tally]
) -> None:  # fmt: skip
    """Kill one run or sweep so many times, let it end, and compare it with the whole one."""
    folder.mkdir(parents=True)
    done: list[int] = []
    while len(done) < kills:
        number = kind.numbers[sum(tally.kills for tally in tallies.values()) % len(kind.numbers)]
        command = Command(kind.command(folder / "it"), folder, PYTHONPATH=str(ROOT))
        deadline = time.monotonic() + draw.uniform(0.1, 0.9) * duration
        while command.process.poll() is None and (
            time.monotonic() < deadline or not (victims := kind.choose(command))
        ):
            time.sleep(0.01)
        if command.process.poll() is not None:
            if all(status(run) == "FINISHED" for run in runs(kind, folder / "it")):
                break  # it was faster; what was killed before counts
            raise RuntimeError(f"{kind.name} ended by itself: {command.output}")
        some = {one.number for one in command.alive() if one.parent == victims[0]} if kind.goes_on else None
        with suppress(ProcessLookupError):
            os.kill(victims[0], number)
        tally = tallies.setdefault(number, Tally())
        seconds = command.seconds_until_gone(3 * ALLOWED, some)
        if kind.goes_on:
            command.process.wait(timeout=20 * duration)
        tally.kills += 1
        tally.ended += seconds <= ALLOWED
        tally.slowest = max(tally.slowest, seconds)
        tally.closed += all(status(run) != "RUNNING" for run in runs(kind, folder / "it"))
        done.append(number)
    last = Command(kind.command(folder / "it"), folder, PYTHONPATH=str(ROOT))
    last.process.wait(timeout=20 * duration)
    found = [
        difference
        for run in runs(kind, folder / "it")
        for difference in differences(run, whole / run.relative_to(folder / "it"))
    ]
    right = not found and all(status(run) == "FINISHED" for run in runs(kind, folder / "it"))
    for number in done:
        tallies[number].same += right
    if not right:
        sys.stderr.write(f"{kind.name}: {folder} differs: {found[:5]}\n")


def measure(kind: Kind, kills: int, draw: random.Random, base: Path) -> list[str]:
    """Lines of the page."""
    whole = base / "whole" / "it"
    whole.parent.mkdir(parents=True)
    start = time.monotonic()
    code = Command(kind.command(whole), whole.parent, PYTHONPATH=str(ROOT)).process.wait(timeout=600)
    duration = time.monotonic() - start
    if code:
        raise RuntimeError(f"{kind.name} failed: {whole.parent / 'output.txt'}")
    tallies: dict[int, Tally] = {}
    for attempt in range(2 * kills):
        left = kills - sum(tally.kills for tally in tallies.values())
        if left <= 0:
            break
        killed(kind, base / str(attempt), whole, duration, min(left, IN_A_ROW), draw, tallies)
    return [
        f"| {kind.name} | {signal.Signals(number).name} | {tally.kills} | {tally.ended} ({tally.slowest:.1f} s) | "
        f"{tally.closed} | {tally.same} |"
        for number, tally in sorted(tallies.items())
    ]


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--kills", type=int, default=4, help="of each kind with each of its signals")
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
            f"`python -m tests.fuzz.kills --kills {kills} --seed {seed}`: each kill comes at a random moment of the "
            "command, from its start on; after up to four the run or sweep is left to end. Ended: no process of the "
            f"command is alive {ALLOWED:.0f} s later (in brackets, the slowest); where the process whose forks are "
            "jobs is killed, none of those jobs, since the sweep goes on. Closed: no run.json says RUNNING then. "
            "Bit-equal: the weights of every checkpoint and every number of every journal are those of the same "
            f"command without a kill. Runs: `{' '.join(RUN)}`, ranks with `{' '.join(RANKS)}`.",
            "",
            "| killed | signal | kills | all ended | closed | resumed bit-equal |",
            "|---|---|---:|---:|---:|---:|",
            *lines,
            "",
            f"{machine('torch', 'pytorch-lightning', 'hydra-core')} Load average at the end: {os.getloadavg()[2]:.0f}.",
            "",
        ]
    )


if __name__ == "__main__":
    main()
