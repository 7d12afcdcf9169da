"""Measure an MLflow server on PostgreSQL: what arrives while it is killed, and what it costs.

    python -m benchmarks.framework.stores

The script starts PostgreSQL and the server on loopback (`tests/store_server.py` says what they need) and writes
stores.md beside this file. `--part` with `outage`, `loss`, `cost` or `sizes` writes one section of the page again.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

from benchmarks.commands import ROOT
from benchmarks.framework.main_job import Done, run_command
from benchmarks.framework.tracking import waiting
from benchmarks.pages import machine, replace_section, write_page
from benchmarks.timing import ROUNDS, median_and_range, require_idle
from framework.tracking.run_info import read_run_info
from tests.store_server import Counts, StoreServer, count

RUNS = 16
EPOCHS = 1000
"""Number of epochs of each run; the runs must still train when all of them have sent `LINES` lines."""
LINES = 50
"""Number of lines of its journal that each run has sent when the server is killed."""
AWAY = 30.0
"""Seconds for which the server is away while the runs train."""
TRAINED = (
    *("experiment=moons/vanilla_128", "trainer.patience=null", "trainer.log_every_steps=5"),
    *("trainer.check_val_every_n_epoch=1", "threads=1"),
)
SHORT = ("experiment=moons/vanilla_128", "debug=fast", "pictures=false", "threads=1")
LARGE = 1000
"""Size of a large file, MB."""
TABLE = (
    "| | in the journals | missing in the store | twice in the store |",
    "|---|---:|---:|---:|",
)


@contextmanager
def serving() -> Iterator[StoreServer]:
    """Start a server for the block, with the variables of a client in the environment."""
    with (
        tempfile.TemporaryDirectory(prefix="store") as folder,
        StoreServer(Path(folder)) as server,
        patch.dict(os.environ, server.environment),
    ):
        yield server


@dataclass
class Sweep:
    """A sweep that trains the models, with the folders of its jobs."""

    epochs: int
    folder: Path

    def __post_init__(self) -> None:
        seeds = ",".join(map(str, range(RUNS)))
        self.command = [
            sys.executable,
            "-m",
            "framework",
            "-m",
            *TRAINED,
            f"trainer.max_epochs={self.epochs}",
        ]
        self.command += [f"seed={seeds}", f"hydra.launcher.jobs={RUNS}", f"hydra.sweep.dir={self.folder}"]
        self.jobs = [self.folder / str(job) for job in range(RUNS)]
        self.begun = time.monotonic()
        self.process = subprocess.Popen(self.command, cwd=ROOT, stdout=subprocess.PIPE, text=True)

    def wait_until_all_send(self) -> str:
        """Wait until every job has sent `LINES` lines, and return how long it took and how many jobs were running.

        Raises:
            RuntimeError: A job has already ended, so that stopping the store now would not affect its training.
        """
        while not all(_sent(job) >= LINES for job in self.jobs):
            if self.process.poll() is not None:
                raise RuntimeError(f"the sweep ended before all jobs had sent {LINES} lines")
            time.sleep(0.2)
        running = sum(_status(job) == "RUNNING" for job in self.jobs)
        if running < RUNS:
            self.process.terminate()
            self.process.wait()
            raise RuntimeError(
                f"only {running} of {RUNS} jobs were still running when all had sent {LINES} lines; train more epochs"
            )
        return (
            f"after {time.monotonic() - self.begun:.0f} s. By then each job had sent {LINES} lines of its journal "
            f"or more, all jobs together {sum(map(_sent, self.jobs)):,} lines, and {running} of the {RUNS} jobs "
            "were still training or testing their model"
        )

    def finish(self) -> float:
        """Wait until the sweep has ended, and return its duration in seconds."""
        self.output, _ = self.process.communicate()
        if self.process.returncode:
            raise subprocess.CalledProcessError(self.process.returncode, self.command)
        return time.monotonic() - self.begun

    def count_logs(self, text: str) -> int:
        """Return how many jobs have printed a text."""
        return sum(text in (job / "console.log").read_text() for job in self.jobs)

    def text(self) -> str:
        """Return the command for the page."""
        return (
            f"`python -m framework -m {' '.join(TRAINED)} trainer.max_epochs={self.epochs} seed=0,…,{RUNS - 1} "
            f"hydra.launcher.jobs={RUNS}`"
        )


def rows(counts: Counts) -> list[str]:
    """Return the rows of the table that compares the journals with the store."""
    return [
        f"| runs | {counts.runs} | 0 | {counts.runs_twice} |",
        f"| numbers of metrics | {counts.values:,} | {counts.lost:,} | {counts.twice:,} |",
        f"| files and models | {counts.files:,} | {counts.files_lost:,} | {counts.files_twice:,} |",
    ]


def measure_outage(server: StoreServer) -> list[str]:
    """Train sixteen models at once, kill the server in the middle, start it again, and count what has arrived."""
    from mlflow import MlflowClient

    with tempfile.TemporaryDirectory() as name:
        sweep = Sweep(EPOCHS, Path(name) / "sweep")
        reached = sweep.wait_until_all_send()
        server.kill()
        time.sleep(AWAY)
        running = sum(_status(job) == "RUNNING" for job in sweep.jobs)
        server.start()
        seconds = sweep.finish()
        counts = count(MlflowClient(server.uri), sweep.jobs)
        again = sweep.count_logs("can be reached again after")
    return [
        f"{sweep.text()} trained {RUNS} models at the same time, in {seconds:.0f} s. The server was killed {reached}. "
        f"The server was started again {AWAY:.0f} s later, when {running} jobs were still running; {again} jobs "
        "printed that the store could be reached again. After the end of the command, the journals were compared with "
        "the store:",
        "",
        *TABLE,
        *rows(counts),
    ]


def measure_loss(server: StoreServer) -> list[str]:
    """Train sixteen models at once, kill the server for good in the middle, and count what `mode=sync` sends later."""
    from mlflow import MlflowClient

    with tempfile.TemporaryDirectory() as name:
        sweep = Sweep(EPOCHS, Path(name) / "sweep")
        reached = sweep.wait_until_all_send()
        server.kill()
        seconds = sweep.finish()
        server.start()
        client = MlflowClient(server.uri)
        before = count(client, sweep.jobs)
        sent, duration = synced(sweep.folder)
        after = count(client, sweep.jobs)
        again, _ = synced(sweep.folder)
        last = count(client, sweep.jobs)
    if last != after:
        raise RuntimeError(f"the second mode=sync has changed the store: {after} became {last}")
    return [
        f"{sweep.text()} ran for {seconds:.0f} s. The server was killed {reached}. The command then tried to "
        "send the remaining lines until it gave up. The server was started again "
        f"after the end of the command; the store lacked {before.lost:,} numbers and {before.files_lost} files. "
        f"Then `python -m framework mode=sync mode.run=<folder of the sweep>` sent {sent:,} lines in "
        f"{duration:.0f} s. The repeated command sent {again} lines and changed nothing. The journals were compared "
        "with the store:",
        "",
        *TABLE,
        *rows(after),
    ]


def synced(folder: Path) -> tuple[int, float]:
    """Send the runs of a sweep with `mode=sync`, and return the number of lines sent and the seconds that it took."""
    start = time.monotonic()
    command = [sys.executable, "-m", "framework", "mode=sync", f"mode.run={folder}"]
    process = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    lines = re.findall(r"(\d+) journal lines\s+sent\s+from", process.stdout)
    if len(lines) != RUNS + 1:  # with the sweep's own run
        raise RuntimeError(f"mode=sync sent {len(lines)} runs instead of {RUNS + 1}:\n{process.stdout}")
    return sum(map(int, lines)), time.monotonic() - start


def _sent(folder: Path) -> int:
    info = read_run_info(folder) if folder.is_dir() else None
    return info.sent if info is not None else 0


def _status(folder: Path) -> str:
    info = read_run_info(folder)
    return info.status if info is not None else ""


def measure_cost(server: StoreServer) -> list[str]:
    """Compare the same short run without a store, with a local store, and with the server."""
    stores = {
        "none": ("`logger=none`", ["logger=none"]),
        "sqlite": ("SQLite file, which exists", ["logger.uri=sqlite:///{folder}/mlflow.db"]),
        "server": ("server on PostgreSQL", [f"logger.uri={server.uri}"]),
    }
    runs: dict[str, list[Done]] = {name: [] for name in stores}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(ROUNDS + 1):
            for name, (_, settings) in stores.items():
                completed = run_command(
                    ROOT, [*SHORT, *(setting.format(folder=folder) for setting in settings)]
                )
                if number:  # the first round makes the stores
                    runs[name].append(completed)
    lines = [
        f"Each cell is the median of {ROUNDS} interleaved rounds (least to largest) of `{' '.join(SHORT)}`, the "
        "shortest run. The first two columns hold the time that a run with a store takes longer than a run without a "
        "store; the processor time includes all processes of the command, but not the server. "
        "The last column is the time between the last line of the journal and the end of the command.",
        "",
        "| store | processor time, s | wall time, s | waiting at the end, s |",
        "|---|---:|---:|---:|",
    ]
    for name in ("sqlite", "server"):
        columns = [
            [
                getattr(completed, part) - getattr(plain, part)
                for completed, plain in zip(runs[name], runs["none"], strict=True)
            ]
            for part in ("processor", "wall")
        ]
        columns.append([waiting(completed) for completed in runs[name]])
        lines.append(f"| {' | '.join([stores[name][0], *map(median_and_range, columns)])} |")
    return lines


def measure_sizes(server: StoreServer) -> list[str]:
    """Measure memory, disk space and the time of a large file."""
    from framework.tracking.mlflow_store import MlflowStore
    from framework.tracking.run_info import Destination
    from framework.tracking.tracker import MlflowTracker

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "run"
        tracker = MlflowTracker(
            folder,
            Destination(None, "sizes", "run"),
            open_store=MlflowStore,
            opening_patience=60,
            patience=300,
        )
        tracker.open()
        empty = server.database_megabytes()
        for step in range(20_000):
            tracker.log_metrics({f"metric {k}": step / 7 for k in range(5)}, step, 0)
        tracker.close("FINISHED")
        if _sent(folder) < tracker.journal.last:
            raise RuntimeError("the store has not accepted all numbers")
        grown = server.database_megabytes() - empty
        file = folder / "large.bin"
        with file.open("wb") as stream:
            for _ in range(LARGE):
                stream.write(os.urandom(1_000_000))
        store = MlflowStore(folder, tracker_info(folder, server.uri))
        server_memory, database_memory = server.memory_megabytes()
        peak_before, start = server.peak_megabytes(), time.perf_counter()
        store.send_file("large.bin", "")
        seconds, peak = time.perf_counter() - start, server.peak_megabytes()
    programs = disk_megabytes([server.programs.parent])
    package = disk_megabytes(Path(sys.prefix).glob("lib/python*/site-packages/psycopg2*"))
    return [
        "| | MB |",
        "|---|---:|",
        f"| PostgreSQL on disk (Debian's server package) | {programs:.0f} |",
        f"| psycopg2 on disk (`pip install '.[postgres]'`) | {package:.0f} |",
        f"| memory of the MLflow server, one worker | {server_memory:.0f} |",
        f"| memory of PostgreSQL | {database_memory:.0f} |",
        f"| an empty database of MLflow | {empty:.0f} |",
        f"| a million numbers of metrics in the database | {grown * 10:.0f} |",
        "",
        "Memory is the proportional set size of all processes. It was measured after 100,000 numbers of metrics "
        "had been sent to the server.",
        "",
        f"A file of {LARGE:,} MB through the server took {seconds:.1f} s ({LARGE / seconds:.0f} MB/s) on loopback; "
        "other programs may have run at the same time. The largest memory of a process of the server was "
        f"{peak_before:.0f} MB before and {peak:.0f} MB afterwards.",
    ]


def tracker_info(folder: Path, uri: str):
    """Return the record of the run in a folder, with the address of its store."""
    from framework.tracking.stores import Address

    info = read_run_info(folder)
    assert info is not None
    return info.at_store(Address(uri, True), folder)


def disk_megabytes(folders: Iterable[Path]) -> float:
    """Return the size of all files in folders, MB."""
    return (
        sum(file.stat().st_size for folder in folders for file in folder.rglob("*") if file.is_file()) / 1e6
    )


SECTIONS = {
    "outage": ("## The server away for half a minute", measure_outage),
    "loss": ("## The server away until the end", measure_loss),
    "cost": ("## What a store adds to a run", measure_cost),
    "sizes": ("## Memory, disk space and large files", measure_sizes),
}


HEAD = [
    "# An MLflow server on PostgreSQL",
    "",
    "This page tests an MLflow server that has a PostgreSQL database and asks for passwords. It says whether all "
    "numbers and files of runs arrive if the server is killed during the runs, and how much time and memory the server "
    "takes. Server, database and runs share one machine. Other programs may have used this machine as well during the "
    "first two tests, so the durations of these tests are upper bounds. [docs/stores.md](../../docs/stores.md) says "
    "how to start the server. Command: `python -m benchmarks.framework.stores`.",
]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--part", choices=SECTIONS, help="measure one section only")
    part = parser.parse_args().part
    warnings.simplefilter("ignore")  # of MLflow's imports
    if part in (None, "cost"):
        require_idle()
    about = f"{machine('mlflow', 'sqlalchemy', 'psycopg2-binary', 'torch')} Synthetic data (`data=moons`)."
    texts = {}
    for name in [part] if part else SECTIONS:
        with serving() as server:
            texts[name] = "\n".join([*SECTIONS[name][1](server), "", about])
    if part:
        replace_section(Path(__file__).with_suffix(".md"), SECTIONS[part][0], texts[part])
        return
    text = [*HEAD]
    for name, (heading, _) in SECTIONS.items():
        text += ["", heading, "", texts[name]]
    write_page(__file__, text)


if __name__ == "__main__":
    main()
