"""Measure a training step with one and with two threads, on free cores and beside a process that uses one of them.

    python -m benchmarks.framework.threads

The script writes threads.md beside this file.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Any
from unittest.mock import patch

from benchmarks.commands import ROOT
from benchmarks.framework.main_job import run_command
from benchmarks.pages import machine, publish
from benchmarks.timing import busy_core, cores_used_by_others, median_and_range
from framework.storage.threads import SPINS

EPOCHS, ROUNDS = 2, 3
RUN = ("experiment=pascal3d/scvae", f"trainer.max_epochs={EPOCHS}", "pictures=false", "logger=none")
KINDS: dict[str, tuple[int, Mapping[str, str]]] = {
    "one thread": (1, {}),
    "two threads, which sleep at once (`OMP_WAIT_POLICY=PASSIVE`)": (2, {"OMP_WAIT_POLICY": "PASSIVE"}),
    f"two threads, `GOMP_SPINCOUNT={SPINS}`, the default of this framework": (2, {"GOMP_SPINCOUNT": SPINS}),
    "two threads, `GOMP_SPINCOUNT=10000`": (2, {"GOMP_SPINCOUNT": "10000"}),
}
"""Number of threads and environment variables of each kind of run."""
PLACES = {False: "free cores", True: "beside a busy process"}
WAITING = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "OMP_NUM_THREADS")


def measure(threads: int, environment: Mapping[str, str], beside: bool) -> dict[str, float]:
    """Run a short training, and return the milliseconds of a step, and the processor seconds of the command."""
    others = {name: value for name, value in os.environ.items() if name not in WAITING}
    with patch.dict(os.environ, {**others, **environment}, clear=True), busy_core(beside):
        done = run_command(ROOT, [*RUN, f"threads={threads}"])
    steps = [(line["step"], line["time"]) for line in done.lines if "train/loss" in line.get("values", ())]
    (first, start), (last, end) = steps[0], steps[-1]
    return {"step": 1e3 * (end - start) / (last - first), "processor": done.processor}


def page(rows: Sequence[dict[str, Any]], others: Sequence[float]) -> str:
    """Return the text of the page; `others` are the numbers of cores that other processes used."""
    titles = [
        f"{place}: {what}" for place in PLACES.values() for what in ("a step, ms", "command, processor s")
    ]
    lines = [
        "# One thread or two",
        "",
        "This page says what a second thread gains in the main job, `python -m framework experiment=pascal3d/scvae` "
        f"(synthetic images, batches of 16), here with `trainer.max_epochs={EPOCHS}`. It also says how long a waiting "
        "OpenMP thread should look for work before it sleeps. A thread that sleeps at once must be woken for every "
        "operation. A thread that does not sleep uses a core for nothing if it waits for a thread whose core another "
        "process uses.",
        "",
        f"Each number is the median of {ROUNDS} rounds (least to largest), in which all runs are made one after the "
        "other. The time of a step is wall time, and includes the validation between two epochs.",
        "",
        f"| threads | {' | '.join(titles)} |",
        f"|---|{'---:|' * len(titles)}",
    ]
    for kind in KINDS:
        cells = [
            median_and_range([row[key] for row in rows if (row["kind"], row["beside"]) == (kind, beside)])
            for beside in PLACES
            for key in ("step", "processor")
        ]
        lines.append(f"| {kind} | {' | '.join(cells)} |")
    lines += [
        "",
        f"Before the rounds, other processes used {median_and_range(others, 2)} cores.",
        "",
        f"{machine('torch', 'pytorch-lightning')} Command: `python -m benchmarks.framework.threads`.",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    rows, others = [], []
    for _ in range(ROUNDS):
        others.append(cores_used_by_others())
        for beside in PLACES:
            for kind, (threads, environment) in KINDS.items():
                rows.append({"kind": kind, "beside": beside, **measure(threads, environment, beside)})
    publish(__file__, page(rows, others))


if __name__ == "__main__":
    main()
