"""Measure the cost per unit of large sweeps, stores and collections of point clouds.

    python -m benchmarks.framework.scale --folder /tmp/scale jobs|table|store|runs|clouds|page

Each step measures one cost and keeps its numbers in the folder; `jobs` measures one round and is repeated five times.
`page` writes scale.md beside this file. docs/scale.md says what follows from the numbers. Delete the folder afterwards.
"""

import json
import shutil
import sqlite3
import sys
import time
import tracemalloc
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.commands import parse_step, timed_command
from benchmarks.pages import machine, write_page
from benchmarks.timing import ROUNDS, median_and_range

RUN = ("experiment=moons/vanilla_128", "debug=fast", "pictures=false", "threads=1")
FEW, MANY = 4, 16
"""Numbers of jobs of two sweeps; the cost of a job is the difference of their times for each additional job."""
STORED = (1_000, 10_000)
"""Numbers of runs of a store."""
FILES = 100_000


def framework(*words: str) -> tuple[float, float]:
    """Run a command; return its wall time and its processor time with all its processes, seconds."""
    return timed_command([sys.executable, "-m", "framework", *words])


def jobs(folder: Path) -> dict[str, Any]:
    """Measure a job that does nothing, and a completed job of a repeated sweep, in seconds per job; one round."""
    times: dict[int, list[tuple[float, float]]] = {}
    for count in (FEW, MANY):
        where = f"hydra.sweep.dir={folder / f'jobs-{time.time_ns()}'}"
        words = ("-m", "mode=plugins", f"seed=range({count})", "hydra.launcher.jobs=2", "logger=none", where)
        times[count] = [framework(*words), framework(*words)]
    costs = {}
    for name, turn in (("job", 0), ("repeated", 1)):
        pairs = zip(times[MANY][turn], times[FEW][turn], strict=True)
        costs[name] = [(many - few) / (MANY - FEW) for many, few in pairs]
    return costs


def table(folder: Path) -> dict[str, Any]:
    """Measure the table and the figure at the end of a sweep, in seconds, for copies of one finished job."""
    from framework.sweeps import comparison

    sweep = folder / "sweep"
    framework("-m", *RUN, "logger=none", "seed=0", f"hydra.sweep.dir={sweep}")
    first = sweep / "0"
    seconds: dict[str, list[float]] = {}
    for count in (100, 1000):
        for number in range(len(list(sweep.glob("*/job.json"))), count):
            copy = sweep / str(number)
            copy.mkdir()
            for name in ("run.json", "results.json"):
                shutil.copy(first / name, copy)
            results = json.loads((copy / "results.json").read_text()) | {"seed": number}
            (copy / "results.json").write_text(json.dumps(results))
            record = json.loads((first / "job.json").read_text())
            record |= {"number": number, "overrides": [f"seed={number}"]}
            (copy / "job.json").write_text(json.dumps(record))
        overrides = [[f"seed={number}"] for number in range(count)]
        call = partial(comparison.summarise, sweep, overrides, {"logger": {"name": "none"}})
        seconds[str(count)] = _times(call)
    return {"table": seconds}


def store(folder: Path) -> dict[str, Any]:
    """Measure a SQLite store with copies of one run: its size, and milliseconds of queries and of a new run."""
    database = folder / "mlflow.db"
    framework(*RUN, f"logger.uri=sqlite:///{database}", f"hydra.run.dir={folder / 'stored'}")
    with closing(sqlite3.connect(database)) as connection:
        rows = {
            name: connection.execute(f"SELECT count(*) FROM {name}").fetchone()[0]
            for name in ("metrics", "params", "tags")
        }
    measured: dict[str, Any] = {}
    have = 1
    for count in STORED:
        _copy_runs(database, have, count)
        have = count
        measured[str(count)] = {"bytes": database.stat().st_size, **_queries(f"sqlite:///{database}")}
    return {"store": measured, "rows": rows}


def _queries(address: str) -> dict[str, list[float]]:
    """Return the seconds of queries of a store, and of a new run."""
    from mlflow.tracking import MlflowClient

    client = MlflowClient(address)
    experiments = [experiment.experiment_id for experiment in client.search_experiments()]
    identity = client.search_runs(experiments, max_results=2)[1].info.run_id
    best = {"order_by": ["metrics.`validation/loss` ASC"], "max_results": 100}

    def new_run() -> None:
        run = client.create_run(experiments[0])
        for step in range(10):
            client.log_metric(run.info.run_id, "loss", 1.0, step=step)
        client.delete_run(run.info.run_id)

    return {
        "page": _times(lambda: client.search_runs(experiments, max_results=100)),
        "metric": _times(lambda: client.search_runs(experiments, **best)),
        "one": _times(lambda: client.get_run(identity)),
        "new": _times(new_run),
    }


def _copy_runs(database: Path, have: int, count: int) -> None:
    """Copy the first run of a store until it holds `count` runs."""
    with closing(sqlite3.connect(database)) as connection, connection:
        (first,) = connection.execute("SELECT min(rowid) FROM runs").fetchone()
        (identity,) = connection.execute("SELECT run_uuid FROM runs WHERE rowid = ?", (first,)).fetchone()
        connection.execute("CREATE TEMP TABLE numbers (n INTEGER)")
        connection.executemany("INSERT INTO numbers VALUES (?)", ((number,) for number in range(have, count)))
        for name in ("runs", "metrics", "latest_metrics", "params", "tags"):
            columns = [row[1] for row in connection.execute(f"PRAGMA table_info({name})")]
            values = ["printf('%032x', n)" if column == "run_uuid" else f'"{column}"' for column in columns]
            named = ", ".join(f'"{column}"' for column in columns)
            connection.execute(
                f"INSERT INTO {name} ({named}) SELECT {', '.join(values)} FROM {name}, numbers WHERE run_uuid = ?",
                (identity,),
            )


def runs(folder: Path) -> dict[str, Any]:
    """Measure the folders of runs: files and bytes of one, and microseconds per run of `checkpoint=last`."""
    from framework.configuration.newest import newest_run

    outputs = folder / "outputs"
    framework(*RUN, "logger=none", f"hydra.run.dir={outputs / '0'}")
    paths = [path for path in (outputs / "0").rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in paths)
    for number in range(1, 2000):
        shutil.copytree(outputs / "0", outputs / str(number))
    microseconds = [1e6 * seconds / 2000 for seconds in _times(lambda: newest_run(outputs))]
    return {"runs": {"files": len(paths), "bytes": size, "last": microseconds}}


def clouds(folder: Path) -> dict[str, Any]:
    """Measure the list of very many files and parts, in microseconds and bytes per file."""
    from framework.datasets.shards import Shards
    from framework.modes.encode import Collection, collect_files

    root = folder / "files"
    for number in range(FILES):
        if number % 1000 == 0:
            (root / f"{number:06}").mkdir(parents=True)
        (root / f"{number // 1000 * 1000:06}" / f"{number:09}.ply").touch()
    listing = [1e6 * seconds / FILES for seconds in _times(lambda: collect_files(root))]
    tracemalloc.start()
    files = collect_files(root)
    names = [file.relative_to(root).as_posix() for file in files]
    memory, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    collection = Collection(Shards(root, 10**8, 1000, (), None, ""), root)
    missing = [1e6 * seconds / collection.parts for seconds in _times(collection.missing)]
    return {"clouds": {"listing": listing, "memory": memory / len(names), "missing": missing}}


def page(measured: dict[str, Any]) -> str:
    """Return the page."""
    rows = []

    def add(name: str, numbers: list[float], unit: str) -> None:
        rows.append(f"| {name} | {median_and_range(numbers, 3)} | {unit} |")

    for name, words in (
        ("job", "a job of a sweep that does nothing, forked"),
        ("repeated", "a completed job when the sweep is repeated"),
    ):
        wall, processor = map(list, zip(*measured["jobs"][name], strict=True))
        add(f"{words}, wall time with two at once", wall, "s per job")
        add(f"{words}, processor time", processor, "s per job")
    for count, seconds in measured["table"].items():
        add(f"the table and the figure at the end of a sweep of {int(count):,} jobs", seconds, "s")
    counts = ", ".join(
        f"{count} {name.replace('_', ' ')}"
        for name, count in measured["rows"].items()
        if name != "latest_metrics"
    )
    for count, numbers in measured["store"].items():
        where = f"in a SQLite store of {int(count):,} runs"
        rows.append(f"| size of a run {where} | {numbers['bytes'] / int(count) / 1e3:.3g} | kB per run |")
        add(f"the newest 100 runs {where}", [1e3 * seconds for seconds in numbers["page"]], "ms")
        add(f"the best 100 runs by a metric {where}", [1e3 * seconds for seconds in numbers["metric"]], "ms")
        add(f"one run by its id {where}", [1e3 * seconds for seconds in numbers["one"]], "ms")
        add(f"a new run with ten numbers {where}", [1e3 * seconds for seconds in numbers["new"]], "ms")
    folder = measured["runs"]
    rows.append(
        f"| folder of a short run: {folder['files']} files | {folder['bytes'] / 1e3:.3g} | kB per run |"
    )
    add("search for `checkpoint=last`", folder["last"], "µs per run")
    cloud = measured["clouds"]
    add("`mode=encode` lists single files", cloud["listing"], "µs per file")
    rows.append(f"| memory for the names of single files | {cloud['memory']:.0f} | bytes per file |")
    add("`mode=encode` looks for missing parts", cloud["missing"], "µs per part")
    return "\n".join(
        [
            "# Costs per unit of large sweeps, stores and collections",
            "",
            "This page holds the measured costs from which [docs/scale.md](../../docs/scale.md) computes limits. Times "
            f"are medians of {ROUNDS} rounds, with the least and the largest in brackets.",
            "",
            f"The stored run is `{' '.join(RUN)}`, which has {counts} in MLflow; the store is filled with copies "
            "of this run. The jobs of the sweeps do almost nothing (`mode=plugins`). The cost of a job is the "
            f"difference between the costs of a sweep of {MANY} jobs and of one of {FEW} jobs, divided by "
            f"{MANY - FEW}. Other work used a core of the machine while the jobs and the store were measured, so "
            "their wall times are upper bounds.",
            "",
            "| cost | measured | unit |",
            "|---|---:|---|",
            *rows,
            "",
            f"{machine('torch', 'hydra-core', 'mlflow', 'sqlalchemy')} Command: `python -m benchmarks.framework.scale` "
            "with the steps `jobs`, `table`, `store`, `runs`, `clouds` and `page`.",
            "",
        ]
    )


def main() -> None:
    steps = {"table": table, "store": store, "runs": runs, "clouds": clouds}
    step, folder = parse_step(__doc__, ("jobs", *steps, "page"), "folder for inputs and results")
    folder.mkdir(parents=True, exist_ok=True)
    stored = folder / "measured.json"
    measured = json.loads(stored.read_text(encoding="utf-8")) if stored.is_file() else {}
    if step == "page":
        write_page(__file__, page(measured))
    elif step == "jobs":
        rounds = measured.setdefault("jobs", {"job": [], "repeated": []})
        for name, cost in jobs(folder).items():
            rounds[name].append(cost)
        stored.write_text(json.dumps(measured), encoding="utf-8")
    else:
        measured |= steps[step](folder)
        stored.write_text(json.dumps(measured), encoding="utf-8")


def _times(call: Callable[[], object]) -> list[float]:
    """Return the wall times of `ROUNDS` calls after one to warm up, seconds."""
    call()
    times = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return times


if __name__ == "__main__":
    main()
