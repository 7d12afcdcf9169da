"""Measure what the tracking of a run in MLflow costs, before and after a change.

    python -m benchmarks.framework.tracking --before 950f55d

The script writes tracking.md beside this file. With `--floor` it measures only the last section, on the import of
MLflow, and replaces it.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from benchmarks.commands import ROOT, children_seconds
from benchmarks.framework.main_job import Done, run_command, source
from benchmarks.pages import machine, publish, replace_section
from benchmarks.timing import ROUNDS, cores_used_by_others, median_and_range, require_idle

RUN = ("experiment=moons/vanilla_128", "debug=fast", "pictures=false", "threads=1")
STORES = ("none", "mlflow")
FLOOR_HEADING = "## The import of MLflow alone"
FLOOR_ROUNDS = 3


def waiting(command: Done) -> float:
    """Return the seconds from the last line of the journal to the end of the command."""
    return command.start + command.wall - command.lines[-1]["time"]


def cells(runs: Sequence[dict[str, Done]]) -> list[str]:
    """Return the cells of a version: processor time and wall time that the store adds, and the waiting at the end."""
    differences = [
        [getattr(run["mlflow"], name) - getattr(run["none"], name) for run in runs]
        for name in ("processor", "wall")
    ]
    return [median_and_range(numbers) for numbers in (*differences, [waiting(run["mlflow"]) for run in runs])]


def import_seconds() -> float:
    """Return the processor seconds of the process that writes to the store, if it imports MLflow and writes nothing."""
    before = children_seconds()
    command = [sys.executable, "-P", "-m", "framework.tracking.store_process"]
    subprocess.run(command, cwd=ROOT, stdin=subprocess.DEVNULL, check=True, env={**os.environ})
    return children_seconds() - before


def floor_section() -> str:
    """Measure the import of MLflow beside the whole cost of the store, and return the text of the section."""
    others = [cores_used_by_others()]
    imports, new, known = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        run_command(ROOT, [*RUN, "logger=mlflow"], Path(folder))  # creates the store
        for _ in range(FLOOR_ROUNDS):
            without = run_command(ROOT, [*RUN, "logger=none"]).processor
            new.append(run_command(ROOT, [*RUN, "logger=mlflow"]).processor - without)
            known.append(run_command(ROOT, [*RUN, "logger=mlflow"], Path(folder)).processor - without)
            imports.append(import_seconds())
    others.append(cores_used_by_others())
    return "\n".join(
        [
            "A separate process writes to the store, and no run that uses MLflow can save the import of MLflow in this "
            "process. The first run also creates the store, with all migrations of MLflow's database; later runs find "
            "it. This table gives the processor time that a store adds to the run above: first if the run creates the "
            "store, then if the store exists. The last row is the time of the separate process if it imports MLflow "
            f"and ends. The project wants a store to add at most 2 s. Each number is the median of {FLOOR_ROUNDS} "
            "rounds (least to largest), in which all are measured one after the other.",
            "",
            "| part | processor time, s |",
            "|---|---:|",
            f"| a new store | {median_and_range(new)} |",
            f"| a store of earlier runs | {median_and_range(known)} |",
            f"| the import of MLflow and the start of its process | {median_and_range(imports)} |",
            "",
            f"Other processes used {others[0]:.1f} cores before and {others[1]:.1f} cores after the measurement, which "
            "lengthens processor times. The waiting at the end is not measured beside such work.",
            "",
            f"{machine('mlflow', 'torch')} Command: `python -m benchmarks.framework.tracking --floor`.",
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--before", default="950f55d", help="commit to compare with")
    parser.add_argument("--floor", action="store_true", help="measure only the import of MLflow")
    chosen = parser.parse_args()
    if chosen.floor:
        replace_section(Path(__file__).with_suffix(".md"), FLOOR_HEADING, floor_section())
        return
    commit = chosen.before
    require_idle()
    runs: dict[str, list[dict[str, Done]]] = {"before": [], "after": []}
    with source(commit) as before, source(None) as after:
        for tree in (before, after):
            run_command(tree, [*RUN, "logger=mlflow"])  # reads the files of all packages into memory
        for _ in range(ROUNDS):
            for version, tree in {"before": before, "after": after}.items():
                runs[version].append(
                    {store: run_command(tree, [*RUN, f"logger={store}"]) for store in STORES}
                )
    text = "\n".join(
        [
            "# What the tracking of a run in MLflow costs",
            "",
            "This page says how much longer a run takes because it is sent to MLflow. The run is as short as possible, "
            f"so that nothing hides the cost: `{' '.join(RUN)}`, with `logger=mlflow` (a new SQLite store, which is "
            f"created in the run) and with `logger=none`. `before` is the version of commit `{commit}`, `after` is "
            "the version at the date of this page.",
            "",
            "The first two columns of the table are differences between the run with `logger=mlflow` and the run "
            "with `logger=none`. Processor time includes all processes of the command. The last column is "
            "the time between the last line of the journal, which says that the run has finished, and the end of the "
            f"command. Each number is the median of {ROUNDS} rounds (least to largest); in each round, all runs are "
            "made one after the other.",
            "",
            "| version | processor time that the store adds, s | wall time that the store adds, s | waiting at the "
            "end, s |",
            "|---|---:|---:|---:|",
            *(f"| {' | '.join([version, *cells(rounds)])} |" for version, rounds in runs.items()),
            "",
            f"{machine('mlflow', 'torch')} Command: `python -m benchmarks.framework.tracking --before {commit}`.",
            "",
            FLOOR_HEADING,
            "",
            floor_section(),
            "",
        ]
    )
    publish(__file__, text)


if __name__ == "__main__":
    main()
