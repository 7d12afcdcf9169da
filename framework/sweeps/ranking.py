"""Ranking of the trials of a search, with the Pareto front of two metrics."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml

from framework.errors import ConfigError, count_of, did_you_mean
from framework.evaluation.pareto import TIME_NOISE, front
from framework.reports.table import COST_BETTER, COST_COLUMNS, Better, results_table, write_csv
from framework.storage.files import write_whole
from framework.storage.plain_values import is_number
from framework.storage.progress import output
from framework.sweeps.comparison import close_parent
from framework.sweeps.results import read_results

_WAYS: Mapping[str, Literal["higher", "lower"]] = {"minimize": "lower", "maximize": "higher"}
RETURNED = "best validation loss (nats)"
"""Name, in tables, of the value that a training returns to its sweep."""
MILLISECONDS = "milliseconds_per_sample"
RESULTS = "optimization_results.yaml"
"""File with the best trial, or the trials of the front; it has the keys that Hydra's sweepers for Optuna, Ax and
Nevergrad write."""


@dataclass(frozen=True)
class Trial:
    """One job of a search.

    Attributes:
        folder: Folder of the job.
        overrides: Overrides of the job.
        value: Number that the job returned; None if it returned none.
        completed: Whether the job has completed.
        note: Why a trial that has not completed has no value.
        study_values: For a job whose folder is on another machine, the value of each metric, with the sign that makes
            lower values better; None for any other job.
    """

    folder: Path
    overrides: list[str]
    value: float | None
    completed: bool
    note: str = "did not complete"
    study_values: Sequence[float] | None = None


@dataclass(frozen=True)
class Measured:
    """Metrics of the trials of a search.

    Attributes:
        metrics: Key of each metric in results.json; None: the number that a job returns.
        headings: Heading of each metric.
        ways: Direction in which each metric is better; None if the results of no trial state it.
        values: Values of each trial, one for each metric; NaN without a value.
        results: Content of results.json of each trial; empty if there is none.
    """

    metrics: Sequence[str | None]
    headings: list[str]
    ways: list[Literal["higher", "lower"] | None]
    values: list[list[float]]
    results: list[dict[str, Any]]

    def objectives(self, trial: int) -> list[float]:
        """Return the values of a trial with the sign that makes lower values better."""
        return [
            -value if way == "higher" else value
            for value, way in zip(self.values[trial], self.ways, strict=True)
        ]


@dataclass(frozen=True)
class Ranking:
    """Result of a search.

    Attributes:
        best: Best trial by the first metric, among those of the front; None if no trial has a finite value.
        summary: Line that states the values of the best trial.
        front: With two metrics, the trials of the Pareto front, best first; otherwise the best trial.
        values: Values of each trial of the front, one for each metric.
    """

    best: Trial | None
    summary: str
    front: list[Trial] = field(default_factory=list)
    values: list[list[float]] = field(default_factory=list)


def measure(
    folder: Path,
    trials: Sequence[Trial],
    metrics: Sequence[str | None],
    directions: Sequence[str | None],
) -> Measured:
    """Read the metrics of trials from their folders.

    Args:
        folder: Folder of the search.
        trials: Trials of the search.
        metrics: Keys of results.json; None: the number that a trial returned.
        directions: "minimize" or "maximize" for each metric; None takes the direction from the metric.

    Raises:
        ConfigError: No trial has a metric, or the direction of a metric is not known.
    """
    results = [read_results(trial.folder) if trial.completed else {} for trial in trials]
    known = [result for result in results if result]
    headings, ways = [], []
    for metric, direction in zip(metrics, directions, strict=True):
        way = None if direction is None else _WAYS[direction]
        heading = RETURNED
        if metric is None:
            way = way or "lower"
        else:
            columns = {key: head for result in known for key, head in result["columns"].items()}
            heading = {**COST_COLUMNS, **columns}.get(metric, metric)
            way = _way(metric, known, direction, folder) if known else way
        headings.append(heading)
        ways.append(way)
    values = [_values(trial, result, metrics, ways) for trial, result in zip(trials, results, strict=True)]
    return Measured(metrics, headings, ways, values, results)


def rank(
    folder: Path,
    trials: Sequence[Trial],
    keys: Sequence[str],
    metrics: Sequence[str | None] = (None,),
    directions: Sequence[str | None] = (None,),
) -> Ranking:
    """Print the trials of a search as a table, write them to ranking.csv, and return the best ones.

    The table begins with the best trial or, with two metrics, with the trials of the Pareto front, and trials without a
    finite value are its last rows. On the front, run times within `TIME_NOISE` count as equal.

    Args:
        folder: Folder of the search.
        trials: Trials, in the order in which they were suggested.
        keys: Overridden keys to show, one column each.
        metrics: One or two keys of results.json by which trials are ranked; None: the value that the trials returned.
        directions: "minimize" or "maximize" for each metric; None takes the direction from the metric.

    Raises:
        ConfigError: No trial has a metric, or its direction is not known.
    """
    measured = measure(folder, trials, metrics, directions)
    objectives = [measured.objectives(index) for index in range(len(trials))]
    finite = [all(map(math.isfinite, values)) for values in objectives]
    on_front = _front(objectives, metrics) if len(metrics) == 2 else [False] * len(trials)
    # The sort is stable: of equal trials, the one suggested first comes first.
    order = sorted(
        range(len(trials)),
        key=lambda index: (
            not finite[index],
            not on_front[index],
            objectives[index][0] if finite[index] else 0,
        ),
    )
    value_keys = ["value", *(metric or "value" for metric in metrics[1:])]
    rows = [
        _trial_row(trial, result, keys, dict(zip(value_keys, values, strict=True)))
        for trial, result, values in zip(trials, measured.results, measured.values, strict=True)
    ]
    synthetic = any(row["synthetic"] for row in rows)
    # A failed trial has no results that say whether its data are synthetic; it is labelled like the others.
    shown = [
        {
            **rows[index],
            "synthetic": synthetic if rows[index]["synthetic"] is None else rows[index]["synthetic"],
        }
        | ({"front": on_front[index]} if len(metrics) == 2 else {})
        for index in order
    ]
    columns = {
        "trial": "trial",
        **({"front": "on the front"} if len(metrics) == 2 else {}),
        **dict(zip(value_keys, measured.headings, strict=True)),
        **{key: key.lstrip("+").rpartition(".")[2] for key in keys},
    }
    costs = {key: head for key, head in COST_COLUMNS.items() if any(row[key] is not None for row in rows)}
    columns |= {key: head for key, head in costs.items() if key not in columns}
    console = output()
    title = f"{count_of(len(trials), 'trial')} in {folder}, best first"
    better: Better = {key: way or "lower" for key, way in zip(value_keys, measured.ways, strict=True)}
    console.print(results_table(shown, columns, title=title, better=better))
    write_csv(shown, columns, folder / "ranking.csv")
    _explain(trials, measured, finite, len(metrics) == 2)
    if not any(finite):
        return Ranking(None, "")
    best = order[0]
    summary = ", ".join(
        f"{heading}: {value:.6g}"
        for heading, value in zip(measured.headings, measured.values[best], strict=True)
    )
    chosen = [index for index in order if on_front[index]] or [best]
    return Ranking(
        trials[best],
        summary + (" (synthetic data)" if rows[best]["synthetic"] else ""),
        [trials[index] for index in chosen],
        [measured.values[index] for index in chosen],
    )


def write_results(folder: Path, name: str, ranking: Ranking, keys: Sequence[str]) -> None:
    """Write the best trial, or the trials of the front, to `RESULTS` in the folder of a search.

    Args:
        folder: Folder of the search.
        name: Name of the sweeper.
        ranking: Result of the search.
        keys: Keys of the search space.
    """
    solutions = [
        {"params": {key: _plain_value(_overridden(trial)[key]) for key in keys}, "values": values}
        for trial, values in zip(ranking.front, ranking.values, strict=True)
    ]
    content: dict[str, Any] = {"name": name}
    if len(solutions) == 1 and len(solutions[0]["values"]) == 1:
        content |= {"best_params": solutions[0]["params"], "best_value": solutions[0]["values"][0]}
    else:
        content |= {"solutions": solutions}
    write_whole(folder / RESULTS, yaml.safe_dump(content, sort_keys=False).encode())


def close_ranking(folder: Path, summary: str, config: Mapping[str, Any]) -> None:
    """Log the files of a search to its parent run in the tracking store, and close this run.

    Without a parent run, the function does nothing.

    Args:
        folder: Folder of the search.
        summary: Text for the description of the parent run.
        config: Composed config of the first job.
    """
    paths = (folder / name for name in ("ranking.csv", "best.yaml", RESULTS))
    close_parent(folder, [path for path in paths if path.is_file()], summary, config)


def _front(objectives: Sequence[Sequence[float]], metrics: Sequence[str | None]) -> list[bool]:
    """Return for each trial whether it is on the Pareto front of two metrics."""
    if not objectives:
        return []
    first, second = zip(*objectives, strict=True)
    if metrics[0] == MILLISECONDS:
        first, second, metrics = second, first, metrics[::-1]
    return front(first, second, TIME_NOISE if metrics[1] == MILLISECONDS else 0.0)


def _explain(trials: Sequence[Trial], measured: Measured, finite: Sequence[bool], has_front: bool) -> None:
    """Print which trials are last and why, and how far the numbers of the table can be trusted."""
    console = output()
    last = [
        f"#{trial.folder.name} "
        + (f"(value {', '.join(f'{value:g}' for value in values)})" if trial.completed else f"({trial.note})")
        for trial, values, is_finite in zip(trials, measured.values, finite, strict=True)
        if not is_finite
    ]
    if last:
        console.print(f"ranked last, without a finite value: {', '.join(last)}", soft_wrap=True)
    if has_front:
        noise = (
            f"; run times within {100 * TIME_NOISE:g} % count as equal"
            if MILLISECONDS in measured.metrics
            else ""
        )
        console.print(f"on the front: no other trial is better in one metric and as good in the other{noise}")
    tested = [metric for metric in measured.metrics if metric is not None and metric not in COST_COLUMNS]
    if tested:
        console.print(
            f"{' and '.join(tested)} was computed on the test split, which was used to choose the trial, so the best "
            "value is not an estimate for new data.",
            soft_wrap=True,
        )


def _values(
    trial: Trial,
    results: Mapping[str, Any],
    metrics: Sequence[str | None],
    ways: Sequence[Literal["higher", "lower"] | None],
) -> list[float]:
    """Return the values of a trial, one for each metric; NaN for a value that it does not have."""
    if trial.study_values is not None and not results:
        return [
            -value if way == "higher" else value for value, way in zip(trial.study_values, ways, strict=True)
        ]
    values = [trial.value if metric is None else results.get(metric) for metric in metrics]
    return [float(value) if is_number(value) and trial.completed else math.nan for value in values]


def _overridden(trial: Trial) -> dict[str, str]:
    return {key: text for key, _, text in (override.partition("=") for override in trial.overrides)}


def _plain_value(text: str) -> Any:
    """Return the number or list of numbers that an override states, or its text."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def _trial_row(
    trial: Trial, results: Mapping[str, Any], keys: Sequence[str], values: Mapping[str, float]
) -> dict[str, Any]:
    """Return a trial's row of the table; "synthetic" is None without results."""
    overridden = _overridden(trial)
    return {
        "trial": trial.folder.name,
        **{key: overridden.get(key) for key in keys},
        **{key: results.get(key) for key in COST_COLUMNS},
        **values,
        "synthetic": results.get("synthetic"),
    }


def _way(
    metric: str, results: Sequence[Mapping[str, Any]], direction: str | None, folder: Path
) -> Literal["higher", "lower"]:
    repeat = (
        f"The same command with hydra.sweep.dir={folder} ranks the trials again without running them again."
    )
    numbers = {key: None for result in results for key, value in result.items() if is_number(value)}
    if metric not in numbers:
        raise ConfigError(
            f"hydra.sweeper.metric = {metric!r}: no trial has a number of this name."
            f"{did_you_mean(metric, numbers)} The trials have: {', '.join(numbers)}; null stands for "
            f"the {RETURNED}. {repeat}"
        )
    ways: Better = {
        **COST_BETTER,
        **next((result["better"] for result in results if metric in result["better"]), {}),
    }
    if metric not in ways and direction is None:
        raise ConfigError(
            f"hydra.sweeper.metric = {metric!r} does not state whether higher or lower is better. Set "
            f"hydra.sweeper.direction to minimize or maximize. {repeat}"
        )
    return _WAYS[direction] if direction is not None else ways[metric]
