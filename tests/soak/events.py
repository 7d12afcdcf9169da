"""Events of the soak test that are more than one kill: two sweeps in one folder, and a store that is away."""

import json
import random
import socket
import sqlite3
import sys
import time
import urllib.request
from collections import Counter
from collections.abc import Mapping
from contextlib import closing, suppress
from pathlib import Path

from tests.fuzz.kills import ALLOWED, ROOT, RUN, Command, Kind, differences, first, runs, start, status

PATIENCE = 300.0
"""Seconds after which a command counts as hanging."""
SERVER = """
import logging, os, sys
from werkzeug.serving import make_server
from mlflow.server import app
logging.getLogger("werkzeug").setLevel(logging.ERROR)
make_server("127.0.0.1", int(sys.argv[1]), app, threaded=True).serve_forever()
"""
"""Script that serves the store whose address is in the environment."""
TABLES = """
import sys
from pathlib import Path
from reproduction import thesis_tables
thesis_tables.FOLDER = Path(sys.argv[1])
sys.argv[1:] = ["2.1", "--seeds", "1"]
thesis_tables.main()
"""
"""Script that makes a table of the thesis in a folder of its own."""


def two_sweeps(folder: Path, whole: Path, draw: random.Random, duration: float) -> tuple[int, list[str]]:
    """Run two sweeps that share two of three jobs in one folder, kill the first, and repeat it.

    Args:
        folder: Folder for the sweeps.
        whole: Folder of a sweep with the seeds 0, 1 and 2 that was not disturbed.
        draw: Source of the moment of the kill.
        duration: Seconds that the undisturbed sweep took.

    Returns:
        Number of kills, and what is lost, torn or different.
    """
    folder.mkdir(parents=True)
    kinds = [
        Kind("", ("-m", *RUN, f"seed={seeds}", "hydra.launcher.fork=true"), first, sweep=True)
        for seeds in ("0,1", "1,2")
    ]
    commands = [start(kind, folder / "it") for kind in kinds]
    time.sleep(draw.uniform(0.1, 0.9) * duration)
    with suppress(ProcessLookupError):
        commands[0].process.kill()
    faults = [] if commands[0].seconds_until_gone(30.0) < 30 else ["a process of the killed sweep was left"]
    faults += [f"the second sweep ended with {code}" for code in [commands[1].process.wait(PATIENCE)] if code]
    faults += [
        f"the repeated sweep ended with {code}"
        for code in [start(kinds[0], folder / "it").process.wait(PATIENCE)]
        if code
    ]
    jobs = {_seed(run): run for run in runs(kinds[0], folder / "it")}
    wanted = {_seed(run): run for run in runs(kinds[0], whole)}
    if jobs.keys() != wanted.keys() or len(runs(kinds[0], folder / "it")) != len(wanted):
        return 1, [*faults, f"the jobs are {sorted(jobs)}"]
    for seed, run in jobs.items():
        faults += [f"seed {seed}: {fault}" for fault in differences(run, wanted[seed])]
        if status(run) != "FINISHED":
            faults.append(f"seed {seed}: {status(run)}")
    return 1, faults


def _seed(run: Path) -> str:
    overrides = json.loads((run / "job.json").read_text(encoding="utf-8"))["overrides"]
    return next(override for override in overrides if override.startswith("seed="))


def store_away(folder: Path, whole: Path, draw: random.Random, duration: float) -> tuple[int, list[str]]:
    """Kill the server of the store during a run, kill the run too, and start both again.

    Args:
        folder: Folder for the run and the store.
        whole: Folder of the same run without a kill.
        draw: Source of the moments of the kills.
        duration: Seconds that the undisturbed run took.

    Returns:
        Number of kills, and numbers of the journal that the store lacks or has twice.
    """
    folder.mkdir(parents=True)
    database, port = folder / "mlflow.db", _free_port()
    environment = {
        "_MLFLOW_SERVER_FILE_STORE": f"sqlite:///{database}",
        "_MLFLOW_SERVER_ARTIFACT_ROOT": str(folder / "artifacts"),
        "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
    }
    words = [word for word in RUN if word != "logger=none"]
    kind = Kind(
        "",
        (*words, f"logger.uri=http://127.0.0.1:{port}"),
        first,
        environment={"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "0"},
    )
    server = _serve(folder, port, environment)
    kills = 0
    try:
        run = start(kind, folder / "it")
        time.sleep(draw.uniform(0.3, 0.8) * duration)
        server.process.kill()
        kills += 1
        time.sleep(draw.uniform(0.0, 0.3) * duration)
        if run.process.poll() is None:
            run.process.kill()
            kills += 1
        run.seconds_until_gone(30.0)
        server.seconds_until_gone(30.0)
        again = start(kind, folder / "it")  # the store is still away
        time.sleep(draw.uniform(0.1, 0.6) * duration)
        server = _serve(folder, port, environment)
        faults = [f"the resumed run ended with {code}" for code in [again.process.wait(PATIENCE)] if code]
        sync = [
            sys.executable,
            "-P",
            "-m",
            "framework",
            "mode=sync",
            f"mode.run={folder / 'it'}",
            f"logger.uri=http://127.0.0.1:{port}",
        ]
        code = Command(sync, folder, PYTHONPATH=str(ROOT)).process.wait(PATIENCE)
        faults += [f"mode=sync ended with {code}"] if code else []
    finally:
        server.process.kill()
        server.seconds_until_gone(30.0)
    faults += differences(folder / "it", whole)
    return kills, faults + _missing(folder / "it", database)


def thesis_tables(folder: Path, whole: Path, draw: random.Random, duration: float) -> tuple[int, list[str]]:
    """Kill the script that makes the thesis's tables while it runs a sweep, and wait for its processes to end.

    Args:
        folder: Folder for the runs.
        whole: Not read; all events have the same parameters.
        draw: Source of the moment of the kill.
        duration: Seconds that a short sweep takes.

    Returns:
        Number of kills, and processes that were left.
    """
    folder.mkdir(parents=True)
    script = Command([sys.executable, "-c", TABLES, str(folder / "tables")], folder, PYTHONPATH=str(ROOT))
    time.sleep(draw.uniform(0.3, 2.0) * duration)
    if script.process.poll() is not None:
        return 0, [f"the script ended with {script.process.wait()}"]
    script.process.kill()
    return 1, [] if script.seconds_until_gone(ALLOWED) <= ALLOWED else ["a process was left"]


def _missing(run: Path, database: Path) -> list[str]:
    """Return the numbers of a journal that the store lacks, has twice, or has in addition."""
    wanted: Counter[tuple[str, int]] = Counter()
    for line in (run / "journal.jsonl").read_text(encoding="utf-8").splitlines():
        record = json.loads(line)
        wanted.update((name, record["step"]) for name in record.get("values", {}))
    with closing(sqlite3.connect(database)) as store:
        stored = Counter((key, step) for key, step in store.execute("SELECT key, step FROM metrics"))
        count = store.execute("SELECT count(*) FROM runs").fetchone()[0]
    faults = [f"{name} of step {step} is not in the store" for name, step in (wanted - stored)]
    faults += [
        f"{name} of step {step} is in the store, but not in the journal" for name, step in (stored - wanted)
    ]
    return faults if count == 1 else [*faults, f"the store has {count} runs"]


def _serve(folder: Path, port: int, environment: Mapping[str, str]) -> Command:
    """Start the server of the store, and wait until it has answered a request from its database.

    The server creates the tables of a new database at the first request. MLflow cannot repair an SQLite database if it
    is killed while it creates them, so the kills come later.
    """
    server = Command([sys.executable, "-c", SERVER, str(port)], folder, **environment)
    deadline = time.monotonic() + 120
    while True:
        with suppress(OSError), urllib.request.urlopen(_experiments(port), timeout=60):
            return server
        if time.monotonic() > deadline or server.process.poll() is not None:
            raise RuntimeError(f"the server did not start: {server.output}")
        time.sleep(0.1)


def _experiments(port: int) -> urllib.request.Request:
    """Return a request for the experiments in the store."""
    address = f"http://127.0.0.1:{port}/api/2.0/mlflow/experiments/search"
    return urllib.request.Request(address, b'{"max_results": 1}', {"Content-Type": "application/json"})


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


EVENTS = {
    "two sweeps in one folder": two_sweeps,
    "the store and the run": store_away,
    "`reproduction.thesis_tables`": thesis_tables,
}
"""Functions of the events, by their names on the page."""
