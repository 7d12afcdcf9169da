"""Commands of the soak test, the processes that are killed in them, and what their results are compared by."""

import csv
import json
import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from framework.reports.table import COST_COLUMNS
from tests.fuzz.kills import (
    BOTH,
    ROOT,
    RUN,
    Choose,
    Command,
    Kind,
    Process,
    differences,
    first,
    fork_server,
    numbers,
    sweep,
)

SHORT = ("logger=none", "pictures=false", "threads=1")
"""Settings of every command of the soak test that trains or tests."""
STEPS = ("trainer.log_every_steps=1", "trainer.checkpoint_every_steps=10")
"""Settings of every training in steps, besides those of its experiment."""
AGAIN = ("hydra.launcher.retries=40",)
"""Setting of a sweep that starts killed jobs again."""
MEASURED = frozenset((*COST_COLUMNS, "latency_milliseconds", "peak_memory_mib", "folder"))
"""Entries of results.json that differ between two runs: their costs and their folder."""
TABLE, CLOUDS = "table.csv", "shards"
"""Input that `prepare` writes: a table for training, and shards of point clouds for encoding."""


@dataclass(frozen=True)
class Soaked:
    """Kind of kill, and its share of all kills.

    Attributes:
        kind: the command and the process to kill.
        weight: number of kills of this kind among 200.
        engine: launcher of the sweep, if it is not the pool.
        reference: kind whose undisturbed command gives the results to compare with; None: this kind.
    """

    kind: Kind
    weight: int
    engine: str = ""
    reference: Kind | None = None


def prepare(base: Path) -> None:
    """Write the inputs of the commands into a folder, and train the model that some of them use."""
    draws = np.random.default_rng(0)
    table = draws.normal(size=(2000, 6))
    labels = np.where(table @ draws.normal(size=6) > 0, "high", "low")
    with (base / TABLE).open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow([*"abcdef", "target"])
        writer.writerows([*map(repr, row.tolist()), label] for row, label in zip(table, labels, strict=True))
    (base / CLOUDS).mkdir()
    for number in range(40):
        clouds = draws.standard_normal((500, 2048, 3), dtype=np.float32)
        np.save(base / CLOUDS / f"part-{number:06}.npy", clouds)
    index = {"version": 1, "files": 20_000, "part": 500, "columns": ["x", "y", "z"]}
    (base / CLOUDS / "encoding.json").write_text(json.dumps(index), encoding="utf-8")
    words = (*RUN, "trainer.max_epochs=20", f"hydra.run.dir={base / 'model'}")
    command = Command([sys.executable, "-P", "-m", "framework", *words], base, PYTHONPATH=str(ROOT))
    if command.process.wait(timeout=300):
        raise RuntimeError(f"the model was not trained: {command.output}")


def job(command: Command) -> list[int]:
    """Choose the process of a running job of a sweep, whichever engine runs it."""
    forks = {
        process.number for process in command.alive() if "framework.sweeps.fork_server" in process.command
    }
    return [
        process.number
        for process in command.alive()
        if (process.parent in forks and process.number in forks)
        or ("hydra.mode=RUN" in process.command and _is_framework(process))
    ]


def ray_worker(command: Command) -> list[int]:
    """Choose the process of Ray that runs a job."""
    return [process.number for process in command.alive() if process.command[0].startswith("ray::run_task")]


def _is_framework(process: Process) -> bool:
    return "framework" in process.command or "framework.__main__" in process.command


def file_differences(run: Path, whole: Path) -> list[str]:
    """Return the names of the results, predictions and features in which two runs differ, costs excepted."""
    faults: list[str] = []
    if (whole / "journal.jsonl").is_file():
        faults += [
            f"{name} of step {step}" for name, step in dict(numbers(run).items() ^ numbers(whole).items())
        ]
    if (whole / "results.json").is_file():
        results = [_results(folder) for folder in (run, whole)]
        faults += [
            key for key in results[0].keys() | results[1].keys() if results[0].get(key) != results[1].get(key)
        ]
    names = [path.relative_to(whole) for path in (*whole.glob("*.csv"), *whole.glob("features/*"))]
    names += [path.relative_to(run) for path in run.glob("features/*")]
    for name in dict.fromkeys(names):
        if not (run / name).is_file() or not (whole / name).is_file():
            faults.append(f"{name} is missing")
        elif (run / name).read_bytes() != (whole / name).read_bytes():
            faults.append(str(name))
    return faults


def _results(folder: Path) -> dict[str, Any]:
    results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    return {key: value for key, value in results.items() if key not in MEASURED}


def model_and_file_differences(run: Path, whole: Path) -> list[str]:
    """Return the names of tensors, numbers, results and files in which two runs differ."""
    return [*differences(run, whole), *file_differences(run, whole)]


def same_features(run: Path, whole: Path) -> list[str]:
    """Return the names of features in which the folders that all jobs of two sweeps share differ."""
    return file_differences(run.parent, whole.parent) if run.name == "0" else []


def mode(
    name: str, weight: int, *words: str, compare: Callable[[Path, Path], list[str]] = file_differences
) -> Soaked:
    return Soaked(Kind(name, (*words, "logger=none", "threads=1"), first, BOTH, compare=compare), weight)


def jobs(name: str, *words: str, choose: Choose = job, **more: Any) -> Kind:
    """Return a sweep of which jobs are killed; the sweep starts them again."""
    return Kind(name, ("-m", *words, *AGAIN), choose, sweep=True, goes_on=True, **more)


def pipelines(base: Path) -> dict[str, tuple[str, ...]]:
    """Return the settings of a short training of each pipeline, by its name."""
    words = {
        "images": ("experiment=towncentre/von_mises", "debug=fast", "trainer.max_epochs=20"),
        "a table": (
            *("data=tabular", f"data.path={base / TABLE}", "encoder=[mlp]", "density_head=categorical"),
            *("metric=[accuracy,nll]", "uncertainty=[temperature]", "trainer.max_epochs=40"),
        ),
        "point clouds": ("experiment=modelnet40/bps_mlp", "debug=fast", "trainer.max_epochs=60"),
        "flights": ("experiment=table_tennis/lstm", "debug=fast", "trainer.max_epochs=20"),
    }
    return {name: (*settings, *SHORT, *STEPS) for name, settings in words.items()}


def all_kinds(base: Path, cluster: Mapping[str, str]) -> list[Soaked]:
    """Return all kinds of kills.

    Args:
        base: Folder with the inputs that `prepare` has written.
        cluster: Environment variables that name the SLURM cluster; empty without a cluster.
    """
    model = f"checkpoint={base / 'model'}"
    encode = (
        "mode=encode",
        "encoder=[bps]",
        f"mode.files={base / CLOUDS}",
        "batch_size=100",
        "logger=none",
        "threads=1",
    )
    shares = ("mode.share=1/3,2/3,3/3", "mode.into={folder}/features", "hydra.launcher.jobs=2")
    moons = (*RUN, "seed=0,1,2", "hydra.launcher.jobs=2")
    fork, ray, slurm = "hydra.launcher.fork=true", "hydra/launcher=ray", "hydra/launcher=slurm"
    slurm_conf = {name: value for name, value in cluster.items() if name == "SLURM_CONF"}
    clock = {"PYTHONPATH": os.pathsep.join((str(ROOT), str(ROOT / "tests/soak/clock"))), "CLOCK": "clock"}
    forest = (
        *(
            "data=moons",
            "density_head=extra_trees",
            "encoder=[]",
            "density_head.trees=200",
            "metric=[accuracy]",
        ),
        "pictures=false",
    )
    renderer = ("experiment=smplpix/quick", "debug=fast", "trainer.max_epochs=10", *SHORT, *STEPS)
    pool_job = jobs("a sweep on the pool, a job", *moons, fork)
    return [
        Soaked(Kind("training: moons", RUN, first, BOTH), 12),
        *(
            Soaked(Kind(f"training: {name}", words, first, BOTH), 4)
            for name, words in {**pipelines(base), "a renderer": renderer}.items()
        ),
        mode("training: a forest, which is fitted at once", 4, *forest, compare=model_and_file_differences),
        mode(
            *("calibration", 6, "mode=calibrate", model, "uncertainty=[temperature]", "pictures=false"),
            compare=model_and_file_differences,
        ),
        mode("testing", 6, "mode=test", model, "pictures=false"),
        mode("predicting", 6, "mode=predict", model),
        mode("encoding", 8, *encode, "mode.into={folder}/features"),
        Soaked(
            Kind("encoding by a sweep", ("-m", *encode, *shares), first, sweep=True, compare=same_features), 6
        ),
        Soaked(jobs("encoding by a sweep, a job", *encode, *shares, fork, compare=same_features), 16),
        Soaked(sweep("a sweep on the pool", first, fork), 8),
        Soaked(sweep("a sweep on the pool, its fork server", fork_server, fork, goes_on=True), 8),
        Soaked(pool_job, 24),
        *(
            Soaked(
                jobs(
                    f"a sweep on the pool, a job: {name}", *words, "seed=0,1", "hydra.launcher.jobs=2", fork
                ),
                12,
            )
            for name, words in pipelines(base).items()
        ),
        Soaked(sweep("a script that runs a sweep", first, fork, seeds=2, script=True), 4),
        Soaked(sweep("a sweep on Ray", first, ray, seeds=2), 4, "ray"),
        Soaked(jobs("a sweep on Ray, a job", *moons, ray), 8, "ray", pool_job),
        Soaked(
            jobs("a sweep on Ray, the worker of a job", *moons, ray, choose=ray_worker), 4, "ray", pool_job
        ),
        Soaked(Kind("training while the clock goes back", RUN, first, environment=clock), 4),
        Soaked(sweep("a sweep while the clock goes back", first, fork, environment=clock), 4),
        Soaked(sweep("a sweep on SLURM", first, slurm, outlives=True, environment=slurm_conf), 6, "slurm"),
        Soaked(jobs("a sweep on SLURM, a job", *moons, slurm, environment=slurm_conf), 8, "slurm", pool_job),
    ]
