"""Results of runs: read from their folders, and compared as means over seeds."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from framework.errors import DataError, escape_unprintable, quote, shorten
from framework.reports.table import COST_COLUMNS, SPREADS, Better, aggregate, machine
from framework.runs.job import read_record
from framework.storage.plain_values import is_number, read_json, read_yaml
from framework.storage.reading import RESTORE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_HEADER = ("method", "data", "columns", "better")
"""Keys that results.json of a run must contain."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Comparison:
    """Results of several runs, and their means over seeds.

    Attributes:
        runs: Results of the runs, one row each.
        rows: Means over the runs that differ in their seed only.
        by: Keys that distinguish the rows: "method", "data" and varied settings.
        varied: Settings whose values differ between the runs.
        columns: Headings of the table by key.
        better: For each key, whether a "higher" or a "lower" number is better.
    """

    runs: Sequence[Mapping[str, Any]]
    rows: Sequence[Mapping[str, Any]]
    by: Sequence[str]
    varied: Sequence[str]
    columns: Mapping[str, str]
    better: Better


def compare(runs: Sequence[Mapping[str, Any]], overrides: Sequence[Sequence[str]] = ()) -> Comparison | None:
    """Return the comparison of the results of runs; None if there are none.

    Args:
        runs: Results, each with the "overrides" of its command.
        overrides: Overrides of further jobs, which may lack results; a setting that varies among them counts as varied.
    """
    if not runs:
        return None
    # Jobs of other commands in this folder count too, because every key that distinguishes rows must be shown.
    all_overrides = [*overrides, *(run["overrides"] for run in runs)]
    varied = _varied_keys(all_overrides)
    if _has_repetition(runs, varied):  # some commands do not have the setting
        varied = _varied_keys(all_overrides, absent=True)
    runs = [{**dict.fromkeys(varied), **run} for run in runs]
    shown = (key for key in varied if key not in ("seed", "experiment") and not _repeats_data(runs, key))
    by = ["method", "data", *shown]
    own = runs[0]["columns"]  # headings of costs among them replace the usual ones, in the usual place
    metrics = {key: heading for key, heading in own.items() if key not in COST_COLUMNS}
    costs = {key: own.get(key, heading) for key, heading in COST_COLUMNS.items()}
    columns = {key: key.rpartition(".")[2] for key in by} | metrics | costs
    # Columns without any number are left out.
    columns = {
        key: heading for key, heading in columns.items() if any(run.get(key) is not None for run in runs)
    }
    return Comparison(runs, aggregate(runs, by=by, over="seed"), by, varied, columns, runs[0]["better"])


def headline(compared: Comparison) -> str | None:
    """Return the key of the first number that all rows have, that is not a cost, and that is in `compared.better`."""
    keys = (key for key in compared.runs[0]["columns"] if key in compared.better and key not in COST_COLUMNS)
    return next((key for key in keys if all(key in row for row in compared.rows)), None)


def row_names(compared: Comparison) -> list[str]:
    """Return a name for each row: its method and the values of the varied settings."""
    method, _, *varied = compared.by
    return [
        ", ".join(
            [row[method], *(f"{key.rpartition('.')[2]}={row[key]}" for key in varied if row[key] is not None)]
        )
        for row in compared.rows
    ]


def comparison_figure(compared: Comparison) -> "Figure | None":
    """Return the figure of one number (`headline`) against run time; None without this number or a run time."""
    from framework.reports.tradeoff_picture import error_against_run_time

    runs, rows, data = compared.runs, compared.rows, compared.by[1]
    key = headline(compared)
    if key is None or not all("device" in run for run in runs):
        return None
    heading, titles = compared.columns[key], dict.fromkeys(row[data] for row in rows)
    title = f"{len(titles)} data sets" if len(titles) > 1 else next(iter(titles))
    return error_against_run_time(
        [{**row, "method": name} for row, name in zip(rows, row_names(compared), strict=True)],
        {key: heading},
        compared.better,
        title=f"{title}: {heading} against run time",
        synthetic=any(row.get("synthetic") for row in rows),
        machine="; ".join(dict.fromkeys(machine(run["device"], run["threads"]) for run in runs)),
        group=data if len(titles) > 1 else None,
    )


def job_results(jobs: Sequence[Path]) -> list[dict[str, Any]]:
    """Return the results of the completed jobs that can be read."""
    return [row for row in map(_row, jobs) if row]


def run_results(folder: Path) -> list[dict[str, Any]]:
    """Return the results of a single run, with the overrides of its command, as a list; [] if they cannot be read."""
    results = read_results(folder)
    if not results:
        return []
    path = folder / "overrides.yaml"
    stored = read_yaml(path, "the overrides of a run") if path.is_file() else []
    words = stored if isinstance(stored, list) else []
    overrides = [escape_unprintable(str(word), allowed="") for word in words]
    return [{**results, "overrides": overrides, "folder": str(folder)}]


def _row(job: Path) -> dict[str, Any] | None:
    """Return a job's row of the table; None if the job did not complete or its results cannot be read."""
    record = read_record(job)
    results = read_results(job) if record.get("status") == "completed" else {}
    if not results:
        return None
    overrides = [escape_unprintable(override, allowed="") for override in record["overrides"]]
    swept = dict(override.lstrip("+~").split("=", 1) for override in overrides if "=" in override)
    row = {**swept, **results, "overrides": overrides, "folder": str(job)}
    if "batch_size" in swept:
        # In the results, batch_size is that of the cost measurement, which a small test split limits.
        row["batch_size"] = swept["batch_size"]
    return row


def read_results(job: Path) -> dict[str, Any]:
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
        spreads = [key + ending for key in columns for ending in SPREADS if key + ending in results]
        valid |= {key: _is_spread(results[key]) for key in spreads}
    if invalid := [key for key, is_valid in valid.items() if not is_valid]:
        raise DataError(
            f"{path} has the invalid value {shorten(invalid[0])} = {quote(results.get(invalid[0]))}. {RESTORE}"
        )
    plain = {key: shorten(value) if isinstance(value, str) else value for key, value in results.items()}
    return {**plain, "columns": {key: shorten(heading) for key, heading in columns.items()}}


def _is_spread(value: Any) -> bool:
    """Return whether a value is a standard error or deviation, NaN, or None."""
    return value is None or (is_number(value) and not value < 0)


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
