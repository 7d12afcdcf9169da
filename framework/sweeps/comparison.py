"""Parent run of a sweep, and the table and the figure that compare the sweep's jobs."""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from framework.configuration.settings import store_experiment
from framework.errors import ConfigError, did_you_mean
from framework.reports.table import (
    COST_BETTER,
    COST_COLUMNS,
    Better,
    markdown,
    results_table,
    write_csv,
)
from framework.runs.job import find_job_folders, read_record
from framework.runs.resuming import stored_config
from framework.storage.plain_values import is_number
from framework.storage.progress import output
from framework.sweeps.results import Comparison, compare, comparison_figure, job_results, read_results
from framework.tracking.ended import close_and_send
from framework.tracking.run_info import Destination, RunInfo, read_run_info
from framework.tracking.tracker import MlflowTracker, mlflow_store

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DIRECTIONS: Mapping[str, Literal["higher", "lower"]] = {"minimize": "lower", "maximize": "higher"}
DESCRIPTION, LONGEST_DESCRIPTION = "mlflow.note.content", 7500
"""Tag that MLflow shows as a run's description, and the largest number of characters of a description."""
RETURNED = "best validation loss (nats)"
"""Name, in tables, of the value that a training returns to its sweep."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Trial:
    """One job of a random search; `value` is the number that the job returned, or None if it returned none."""

    folder: Path
    overrides: list[str]
    value: float | None
    completed: bool


@dataclass(frozen=True)
class Ranking:
    """Result of a search: the best trial, or None if no trial has a finite value, and a line that states its value."""

    best: Trial | None
    summary: str


def begin(folder: Path, config: Mapping[str, Any]) -> str | None:
    """Open the parent run of a sweep's jobs in the tracking store, and return its id; None without a store."""
    logger = config.get("logger") or {}
    if logger.get("name") != "mlflow":
        return None
    # not None if a sweep is repeated in this folder; the earlier sweep may have been killed
    earlier = read_run_info(folder)
    tracker = _parent(folder, config, earlier, store_experiment(config))
    tracker.open()
    tracker.set_tags({"mode": "sweep", "folder": str(folder), DESCRIPTION: f"A sweep in `{folder}`."})
    run_id = tracker.run_id
    tracker.leave_open()
    return run_id


def summarise(folder: Path, overrides: Sequence[Sequence[str]], config: Mapping[str, Any]) -> None:
    """Compare the finished jobs in `folder`: print the table, and log it and a figure to the parent run.

    Args:
        folder: Folder of the sweep.
        overrides: Overrides of each job of this command.
        config: Composed config of the first job, as for `begin`; no store but the one that it names is contacted.
    """
    console = output()
    jobs = find_job_folders(folder)
    for job in jobs:
        if _status(job) == "died" and (job / "run.json").is_file():
            close_and_send(job, store_of(config))  # a killed process cannot close its run
    files: list[Path] = []
    summary = ""
    compared = compare(job_results(jobs), overrides)
    if compared:
        from framework.sweeps.pages import failed_jobs, save_report

        title = f"{len(compared.runs)} runs in {folder}"
        better, columns = compared.better, compared.columns
        console.print(results_table(compared.rows, columns, title=title, better=better))
        write_csv(compared.rows, columns, folder / "comparison.csv")
        figure = comparison_figure(compared)
        files = [folder / "comparison.csv", *([] if figure is None else [_save(figure, compared, folder)])]
        console.print(f"comparison: {', '.join(str(file) for file in files)}", soft_wrap=True)
        report = save_report(folder, compared, failed_jobs(jobs), figure, folder)
        console.print(f"report:     {report[0]}", soft_wrap=True)
        files += report
        varied = ", ".join(compared.varied) or "nothing"
        table = markdown(compared.rows, columns, better=better)
        summary = f"{len(compared.runs)} runs over {varied}.\n\n{table}"
    _close_parent(folder, files, summary, config)


def store_of(config: Mapping[str, Any]) -> str | None:
    """Return the address of the store that a sweep's command names; None if it names none."""
    uri = (config.get("logger") or {}).get("uri")
    return None if uri is None else str(uri)


def rank(
    folder: Path,
    trials: Sequence[Trial],
    keys: Sequence[str],
    metric: str | None = None,
    direction: str | None = None,
) -> Ranking:
    """Print the trials of a search as a table, write them to ranking.csv, and return the best trial with its value.

    The table begins with the best trial, and trials without a finite value are its last rows.

    Args:
        folder: Folder of the search.
        trials: Trials, in the order in which they were drawn.
        keys: Overridden keys to show, one column each.
        metric: Key of results.json by which trials are ranked; None: the value that the trials returned.
        direction: "minimize" or "maximize"; None takes the direction from the metric.

    Raises:
        ConfigError: No trial has the metric, or its direction is not known.
    """
    results = {trial.folder: read_results(trial.folder) if trial.completed else {} for trial in trials}
    known = [result for result in results.values() if result]
    heading, better = RETURNED, _DIRECTIONS[direction or "minimize"]
    if metric is not None:
        heading = next((result["columns"][metric] for result in known if metric in result["columns"]), metric)
        better = _direction(metric, known, direction, folder) if known else better
    rows = [_trial_row(trial, results[trial.folder], keys, metric) for trial in trials]
    synthetic = any(row["synthetic"] for row in rows)
    sign = 1 if better == "lower" else -1
    ranks = [sign * row["value"] if math.isfinite(row["value"]) else math.inf for row in rows]
    # The sort is stable: of equal trials, the one drawn first comes first.
    order = sorted(range(len(rows)), key=ranks.__getitem__)
    # A failed trial has no results that say whether its data are synthetic; it is labelled like the others.
    shown = [
        {**row, "synthetic": synthetic if row["synthetic"] is None else row["synthetic"]} for row in rows
    ]
    shown = [shown[index] for index in order]
    columns = {
        "trial": "trial",
        "value": heading,
        **{key: key.lstrip("+").rpartition(".")[2] for key in keys},
    }
    columns |= {key: head for key, head in COST_COLUMNS.items() if any(row[key] is not None for row in rows)}
    console = output()
    title = f"{len(trials)} trials in {folder}, best first"
    console.print(results_table(shown, columns, title=title, better={"value": better}))
    write_csv(shown, columns, folder / "ranking.csv")
    last = [
        f"#{row['trial']} " + (f"(value {row['value']:g})" if trial.completed else "(did not complete)")
        for trial, row, rank in zip(trials, rows, ranks, strict=True)
        if rank == math.inf
    ]
    if last:
        console.print(f"ranked last, without a finite value: {', '.join(last)}", soft_wrap=True)
    if metric is not None:
        console.print(
            f"{metric} was computed on the test split, which was used to choose the trial, so the best value is no "
            "estimate for new data.",
            soft_wrap=True,
        )
    if len(last) == len(trials):
        return Ranking(None, "")
    best = rows[order[0]]
    summary = f"{heading}: {best['value']:.6g}" + (" (synthetic data)" if best["synthetic"] else "")
    return Ranking(trials[order[0]], summary)


def close_ranking(folder: Path, summary: str, config: Mapping[str, Any]) -> None:
    """Log ranking and best trial of a search to its parent run, described by `summary`; `config` is as for `begin`."""
    paths = (folder / name for name in ("ranking.csv", "best.yaml"))
    _close_parent(folder, [path for path in paths if path.is_file()], summary, config)


def _trial_row(
    trial: Trial, results: Mapping[str, Any], keys: Sequence[str], metric: str | None
) -> dict[str, Any]:
    """Return a trial's row of the table; "value" is NaN without a value, and "synthetic" is None without results."""
    value = trial.value if metric is None else results.get(metric)
    overridden = {key: text for key, _, text in (override.partition("=") for override in trial.overrides)}
    return {
        "trial": trial.folder.name,
        "value": float(value) if is_number(value) and trial.completed else math.nan,
        **{key: overridden.get(key) for key in keys},
        **{key: results.get(key) for key in COST_COLUMNS},
        "synthetic": results.get("synthetic"),
    }


def _direction(
    metric: str, results: Sequence[Mapping[str, Any]], direction: str | None, folder: Path
) -> Literal["higher", "lower"]:
    repeat = (
        f"The same command with hydra.sweep.dir={folder} ranks the trials again without running them again."
    )
    numbers = {key: None for result in results for key, value in result.items() if is_number(value)}
    if metric not in numbers:
        raise ConfigError(
            f"hydra.sweeper.metric = {metric!r}: no trial has this number.{did_you_mean(metric, numbers)} The trials "
            f"have: {', '.join(numbers)}; null stands for the {RETURNED}. {repeat}"
        )
    ways: Better = {
        **COST_BETTER,
        **next((result["better"] for result in results if metric in result["better"]), {}),
    }
    if metric not in ways and direction is None:
        raise ConfigError(
            f"hydra.sweeper.metric = {metric!r} has no known direction. Set "
            f"hydra.sweeper.direction to minimize or maximize. {repeat}"
        )
    return _DIRECTIONS[direction] if direction is not None else ways[metric]


def _status(folder: Path) -> str:
    return read_record(folder).get("status", "")


def _save(figure: "Figure", compared: Comparison, folder: Path) -> Path:
    """Save the figure of a comparison in the folder of the sweep, in the format of its jobs' settings."""
    from framework.figures.style import save_figure

    stored = stored_config(Path(compared.runs[0]["folder"]))
    pictures = stored.get("pictures", True) if isinstance(stored, dict) else True
    kind = pictures if pictures in ("png", "pdf", "svg", False) else True
    return save_figure(figure, folder / "comparison", kind)


def _parent(
    folder: Path, config: Mapping[str, Any], earlier: RunInfo | None, experiment: str
) -> MlflowTracker:
    run_id = earlier.run_id if earlier else None
    return MlflowTracker(
        folder,
        Destination(store_of(config), experiment, f"sweep {folder.name}", run_id=run_id),
        opening_patience=30.0,  # the jobs need the run's id
        open_store=mlflow_store(),  # this process also sends the journals of the jobs
    )


def _close_parent(folder: Path, files: Sequence[Path], summary: str, config: Mapping[str, Any]) -> None:
    begun = read_run_info(folder)  # written by `begin` of this command
    if (config.get("logger") or {}).get("name") != "mlflow" or begun is None:
        return
    tracker = _parent(folder, config, begun, begun.experiment)
    tracker.open()
    if summary:  # a text, because a metric of the parent run would be drawn in charts as if it were a job's
        tracker.set_tags({DESCRIPTION: f"A sweep in `{folder}`: {summary}"[:LONGEST_DESCRIPTION]})
    for file in files:
        tracker.log_artifact(file)
    records = [read_record(job) for job in find_job_folders(folder)]
    if any(record.get("status") == "running" and record.get("handle") for record in records):
        tracker.leave_open()  # jobs of an engine go on without this command
    else:
        completed = all(record.get("status") == "completed" for record in records)
        tracker.close("FINISHED" if completed else "FAILED")
