"""Measure what the tracking of a run in MLflow costs, before and after a change.

    python -m benchmarks.framework.tracking --before 950f55d

The script writes tracking.md beside this file.
"""

import argparse
from collections.abc import Sequence

from benchmarks.framework.main_job import Done, run_command, source
from benchmarks.pages import machine, publish
from benchmarks.timing import ROUNDS, median_and_range, require_idle

RUN = ("experiment=moons/vanilla_128", "debug=fast", "pictures=false", "threads=1")
STORES = ("none", "mlflow")


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


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--before", default="950f55d", help="commit to compare with")
    commit = parser.parse_args().before
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
        ]
    )
    publish(__file__, text)


if __name__ == "__main__":
    main()
