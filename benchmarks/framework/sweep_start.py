"""Compare the run time of a sweep whose jobs are forks of one process with that of new processes.

    python -m benchmarks.framework.sweep_start

The sweep consists of very short runs, so that its run time is mainly that of starting the jobs. The two ways to start
the jobs alternate. Processor time is that of the whole command with all its processes. The script writes sweep_start.md
beside this file.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.commands import children_seconds
from benchmarks.pages import machine, write_page

ROOT = Path(__file__).resolve().parents[2]
JOBS, ROUNDS, AT_ONCE = 8, 3, 2
RUNS = ("experiment=moons/vanilla_128", "debug=fast", "pictures=false", "logger=none", "threads=1")


def run_sweep(fork: bool) -> tuple[float, float, list[float]]:
    """Run a sweep, and return its run times.

    Args:
        fork: Start the jobs as forks of one process, instead of new processes.

    Returns:
        Wall time of the command, processor time of the command, and processor time of each job, seconds.
    """
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
        before, start = children_seconds(), time.perf_counter()
        subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL, env={**os.environ})
        elapsed, spent = time.perf_counter() - start, children_seconds() - before
        records = [json.loads((Path(folder) / str(job) / "job.json").read_text()) for job in range(JOBS)]
    return elapsed, spent, [record["processor_seconds"] for record in records]


def main() -> None:
    run_sweep(True)  # warm-up: compiles functions and fills the disk cache
    measured = {fork: [] for fork in (True, False)}
    for _ in range(ROUNDS):
        for fork, sweeps in measured.items():
            sweeps.append(run_sweep(fork))
    median = {
        fork: [statistics.median(result[column] for result in sweeps) for column in (0, 1)]
        for fork, sweeps in measured.items()
    }
    of_job = {
        fork: statistics.median(job for result in sweeps for job in result[2])
        for fork, sweeps in measured.items()
    }
    names = {True: "forks of one process", False: "new processes"}
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
            "This page compares two ways to start the jobs of a sweep: as forks of one process, and as new processes. "
            "On Linux the framework uses forks (`hydra.launcher.fork`). The forked process has imported PyTorch and "
            "Lightning, so that a job need not import them again. The benchmark shows how much time this saves.",
            "",
            f"The measured sweep has {JOBS} jobs, of which {AT_ONCE} run at once. Each job is a very short training "
            f"run (`{' '.join(RUNS)}`). All times are in seconds and are medians of {ROUNDS} sweeps; sweeps with "
            "forks and with new processes alternate. The processor time of a job does not include the process from "
            "which it is forked; the processor time of the sweep includes it. The last row holds the times with new "
            "processes divided by the times with forks.",
            "",
            "| start of the jobs | wall time of the sweep, s | processor time of the sweep, s | processor time of a "
            "job, s |",
            "|---|---:|---:|---:|",
            *lines,
            f"| ratio | {ratios[0]:.2f} | {ratios[1]:.2f} | {of_job[False] / of_job[True]:.2f} |",
            "",
            f"{machine('torch', 'pytorch-lightning', 'hydra-core')} "
            "Command: `python -m benchmarks.framework.sweep_start`.",
        ],
    )


if __name__ == "__main__":
    main()
