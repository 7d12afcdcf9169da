"""Time the start of a sweep's jobs, as forks and as fresh processes.

    python -m benchmarks.framework.sweep_start

The same sweep of runs as short as can be, each job a fork of one process or a process of its own, in turns. Processor
time is of the whole command, all processes. Writes sweep_start.md beside this file.
"""

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.pages import machine, write_page

ROOT = Path(__file__).resolve().parents[2]
JOBS, ROUNDS, AT_ONCE = 8, 3, 2
RUNS = ("experiment=moons/vanilla_128", "debug=fast", "pictures=false", "logger=none", "threads=1")


def sweep(fork: bool) -> tuple[float, float, list[float]]:
    """Seconds by the clock and of processors that the command takes; of processors each job."""
    with tempfile.TemporaryDirectory() as folder:
        settings = (f"hydra.launcher.fork={fork}".lower(), f"hydra.launcher.jobs={AT_ONCE}")
        seeds = "seed=" + ",".join(map(str, range(JOBS)))
        command = [
            sys.executable,
            "-m",
            "framework",
            "-m",
            *RUNS,
            seeds,
            *settings,
            f"hydra.sweep.dir={folder}",
        ]
        before, start = children(), time.perf_counter()
        subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL, env={**os.environ})
        taken, spent = time.perf_counter() - start, children() - before
        records = [json.loads((Path(folder) / str(job) / "job.json").read_text()) for job in range(JOBS)]
    return taken, spent, [record["processor_seconds"] for record in records]


def children() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def main() -> None:
    sweep(True)  # compiles and fills the disk's cache
    measured = {fork: [] for fork in (True, False)}
    for _ in range(ROUNDS):
        for fork, found in measured.items():
            found.append(sweep(fork))
    median = {
        fork: [statistics.median(one[column] for one in found) for column in (0, 1)]
        for fork, found in measured.items()
    }
    of_job = {
        fork: statistics.median(job for one in found for job in one[2]) for fork, found in measured.items()
    }
    names = {True: "forks of one process", False: "a process of its own each"}
    lines = [
        f"| {names[fork]} | {median[fork][0]:.1f} | {median[fork][1]:.1f} | {of_job[fork]:.1f} |"
        for fork in names
    ]
    ratios = [median[False][column] / median[True][column] for column in (0, 1)]
    write_page(
        __file__,
        [
            "# The start of a sweep's jobs",
            "",
            f"`python -m benchmarks.framework.sweep_start`: {JOBS} jobs, {AT_ONCE} at once, `{' '.join(RUNS)}`; "
            f"medians of {ROUNDS} sweeps, in turns. On Linux jobs are forks of a process that has imported torch and "
            "Lightning (`hydra.launcher.fork`); a job's own seconds leave that process out, the command's do not.",
            "",
            "| jobs are | command, s | processors, s | a job, processor s |",
            "|---|---:|---:|---:|",
            *lines,
            f"| ratio | {ratios[0]:.2f} | {ratios[1]:.2f} | {of_job[False] / of_job[True]:.2f} |",
            "",
            machine("torch", "pytorch-lightning", "hydra-core"),
        ],
    )


if __name__ == "__main__":
    main()
