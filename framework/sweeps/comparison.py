"""Parent run of a sweep, and the table and the figure that compare the sweep's jobs."""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from framework.configuration.settings import store_experiment
from framework.errors import ConfigError, DataError, did_you_mean, escape_unprintable, quote, shorten
from framework.reports.table import (
    COST_BETTER,
    COST_COLUMNS,
    Better,
    aggregate,
    machine,
    markdown,
    results_table,
    write_csv,
)
from framework.runs.job import find_job_folders, read_record
from framework.runs.resuming import stored_config
from framework.storage.plain_values import is_number, read_json
from framework.storage.progress import output
from framework.storage.reading import RESTORE
from framework.tracking.ended import close_and_send
from framework.tracking.run_info import Destination, RunInfo, read_run_info
from framework.tracking.tracker import MlflowTracker, mlflow_store

_DIRECTIONS: Mapping[str, Literal["higher", "lower"]] = {"minimize": "lower", "maximize": "higher"}
DESCRIPTION, LONGEST_DESCRIPTION = "mlflow.note.content", 7500
"""Tag that MLflow shows as a run's description, and the largest number of characters of a description."""
RETURNED = "best validation loss (nats)"
"""Name, in tables, of the value that a training returns to its sweep."""
_HEADER = ("method", "data", "columns", "better")
"""Keys that results.json of a job must contain so that the job appears in the table."""

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
    rows = [row for row in map(_row, jobs) if row]
    files: list[Path] = []
    summary = ""
    if rows:
        # Jobs of other commands in this folder count too, because every key that distinguishes rows must be shown.
        all_overrides = [*overrides, *(row["overrides"] for row in rows)]
        keys = _varied_keys(all_overrides)
        if _has_repetition(rows, keys):  # some commands do not have the setting
            keys = _varied_keys(all_overrides, absent=True)
        rows = [{**dict.fromkeys(keys), **row} for row in rows]
        shown = (key for key in keys if key not in ("seed", "experiment") and not _repeats_data(rows, key))
        by = ["method", "data", *shown]
        columns = {key: key.rpartition(".")[2] for key in by} | rows[0]["columns"] | COST_COLUMNS
        # Columns without any number are left out.
        columns = {
            key: heading for key, heading in columns.items() if any(row.get(key) is not None for row in rows)
        }
        compared = aggregate(rows, by=by, over="seed")
        better = rows[0]["better"]
        console.print(results_table(compared, columns, title=f"{len(rows)} runs in {folder}", better=better))
        write_csv(compared, columns, folder / "comparison.csv")
        files.append(folder / "comparison.csv")
        files.extend(_draw_comparison(compared, rows, by, folder))
        console.print(f"comparison: {', '.join(str(file) for file in files)}", soft_wrap=True)
        table = markdown(compared, columns, better=better)
        summary = f"{len(rows)} runs over {', '.join(keys) or 'nothing'}.\n\n{table}"
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
    results = {trial.folder: _results(trial.folder) if trial.completed else {} for trial in trials}
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


def _results(job: Path) -> dict[str, Any]:
    """Return the results of a job; if they cannot be read, log a warning and return an empty dictionary."""
    path = job / "results.json"
    if not path.is_file():
        return {}
    try:
        results = read_json(path, "the results of a job")
        if lacking := [key for key in _HEADER if key not in results]:
            raise DataError(f"{path} lacks {', '.join(lacking)}. {RESTORE}")
        return _check_results(results, path)
    except DataError as error:
        _log.warning("A job is missing in the table: %s", error)
        return {}


def _check_results(results: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Check a job's results, which may come from an untrusted source; return them with texts that are safe to print.

    Raises:
        DataError: A value has a type that no test writes.
    """
    columns, better = results["columns"], results["better"]
    valid = {
        "method": isinstance(results["method"], str),
        "data": isinstance(results["data"], str),
        "seed": isinstance(results.get("seed"), int | str | None)
        and not isinstance(results.get("seed"), bool),
        "device": isinstance(results.get("device"), str | None),
        "threads": type(results.get("threads")) is int or "device" not in results,
        "columns": isinstance(columns, dict)
        and all(isinstance(heading, str) for heading in columns.values()),
        "better": isinstance(better, dict)
        and all(direction in ("higher", "lower") for direction in better.values()),
        **{key: results[key] is None or is_number(results[key]) for key in COST_COLUMNS if key in results},
    }
    if isinstance(columns, dict):
        valid |= {key: results[key] is None or is_number(results[key]) for key in columns if key in results}
    if invalid := [key for key, is_valid in valid.items() if not is_valid]:
        raise DataError(
            f"{path} has the invalid value {shorten(invalid[0])} = {quote(results.get(invalid[0]))}. {RESTORE}"
        )
    plain = {key: shorten(value) if isinstance(value, str) else value for key, value in results.items()}
    return {**plain, "columns": {key: shorten(heading) for key, heading in columns.items()}}


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


def _row(job: Path) -> dict[str, Any] | None:
    """Return a job's row of the table; None if the job did not complete or its results cannot be read."""
    record = read_record(job)
    results = _results(job) if record.get("status") == "completed" else {}
    if not results:
        return None
    overrides = [escape_unprintable(override, allowed="") for override in record["overrides"]]
    swept = dict(override.lstrip("+~").split("=", 1) for override in overrides if "=" in override)
    row = {**swept, **results, "overrides": overrides, "folder": str(job)}
    if "batch_size" in swept:
        # In the results, batch_size is that of the cost measurement, which a small test split limits.
        row["batch_size"] = swept["batch_size"]
    return row


def _varied_keys(overrides: Sequence[Sequence[str]], *, absent: bool = False) -> list[str]:
    """Return the keys with several values among the jobs, in order; with `absent`, also keys that some jobs lack."""
    values_of: dict[str, list[str]] = {}
    for job in overrides:
        for override in job:
            key, _, value = override.lstrip("+~").partition("=")
            values_of.setdefault(key, []).append(value)
    return [
        key
        for key, values in values_of.items()
        if len(set(values)) > 1 or (absent and len(values) < len(overrides))
    ]


def _has_repetition(rows: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> bool:
    """Return whether two rows agree in the method, the data, the seed and the values of `keys`."""
    combinations = [tuple(row.get(key) for key in ("method", "data", "seed", *keys)) for row in rows]
    return len(set(combinations)) < len(combinations)


def _repeats_data(rows: Sequence[Mapping[str, Any]], key: str) -> bool:
    """Return whether the column `key` has several values, but only one for each value of the column `data`."""
    pairs = {(row["data"], row[key]) for row in rows}
    return len({value for _, value in pairs}) > 1 and len({data for data, _ in pairs}) == len(pairs)


def _draw_comparison(
    compared: Sequence[Mapping[str, Any]], rows: Sequence[Mapping[str, Any]], by: Sequence[str], folder: Path
) -> list[Path]:
    """Draw the first column with a known direction against run time; return the files, none if a row lacks a number.

    Args:
        compared: Means of the `rows`, one row for each combination of values of the keys `by`.
        rows: Results of the jobs.
        by: "method", "data" and the keys that were varied.
        folder: Folder of the sweep.
    """
    from framework.figures.style import save_figure
    from framework.reports.tradeoff_picture import error_against_run_time

    headings, better = rows[0]["columns"], rows[0]["better"]
    key = next((key for key in headings if key in better), None)
    if key is None or not all(key in row for row in compared) or not all("device" in row for row in rows):
        return []
    method, data, *varied = by
    names = [
        [row[method], *(f"{name.rpartition('.')[2]}={row[name]}" for name in varied if row[name] is not None)]
        for row in compared
    ]
    several = len({row[data] for row in compared}) > 1
    data_title = f"{len({row[data] for row in compared})} data sets" if several else compared[0][data]
    figure = error_against_run_time(
        [{**row, "method": ", ".join(words)} for row, words in zip(compared, names, strict=True)],
        {key: headings[key]},
        better,
        title=f"{data_title}: {headings[key]} against run time",
        synthetic=any(row.get("synthetic") for row in compared),
        machine="; ".join(dict.fromkeys(machine(row["device"], row["threads"]) for row in rows)),
        group=data if several else None,
    )
    stored = stored_config(Path(rows[0]["folder"]))
    pictures = stored.get("pictures", True) if isinstance(stored, dict) else True
    return [
        save_figure(
            figure, folder / "comparison", pictures if pictures in ("png", "pdf", "svg", False) else True
        )
    ]


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
