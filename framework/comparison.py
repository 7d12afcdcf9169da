"""A sweep as one thing: a parent run, and the table and picture that compare its jobs."""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from framework.report import COST_COLUMNS
from framework.settings import store_experiment
from framework.sweep import RECORD
from framework.table import aggregate, csv, results_table
from framework.tracking import MlflowTracker, mark_dead


def begin(folder: Path, config: Mapping[str, Any]) -> str | None:
    """Open the parent run of a sweep; its id, or None without a tracking store."""
    logger = config.get("logger") or {}
    if logger.get("name") != "mlflow":
        return None
    earlier = folder / "parent.json"  # of the sweep that is being resumed
    known = json.loads(earlier.read_text(encoding="utf-8"))["run_id"] if earlier.is_file() else None
    logger = {**logger, "experiment": store_experiment(config)}
    tracker = _parent(folder, logger, known)
    tracker.open()
    tracker.set_tags({"mode": "sweep", "folder": str(folder)})
    run_id = tracker.run_id
    (folder / "parent.json").write_text(json.dumps({"run_id": run_id, "logger": logger}), encoding="utf-8")
    tracker.leave_open()
    return run_id


def summarise(folder: Path, overrides: Sequence[Sequence[str]]) -> None:
    """Compare the finished jobs in `folder`: print the table, write comparison.csv and .png, log them to the parent."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=160)  # a log file has no edge to wrap at
    for path in folder.glob("*/run.json"):
        if _status(path.parent) == "died":
            mark_dead(path.parent)  # a killed process could not close its run
    rows = [row for row in (_row(path) for path in _in_order(folder.glob("*/results.json"))) if row]
    files: list[Path] = []
    compared: list[dict[str, object]] = []
    if rows:
        keys = _varied(overrides)
        by = ["method", "data", *(key for key in keys if key not in ("seed", "experiment", "data.category"))]
        columns = {key: key.rpartition(".")[2] for key in by} | rows[0]["columns"] | COST_COLUMNS
        # a column that no job has a number for says nothing (what only some classes have, say)
        columns = {
            key: heading for key, heading in columns.items() if any(row.get(key) is not None for row in rows)
        }
        compared = aggregate(rows, by=by, over="seed")
        better = rows[0]["better"]
        console.print(results_table(compared, columns, title=f"{len(rows)} runs in {folder}", better=better))
        csv(compared, columns, folder / "comparison.csv")
        files.append(folder / "comparison.csv")
        files.extend(_picture(compared, by, folder))
        console.print(f"comparison: {', '.join(str(file) for file in files)}", soft_wrap=True)
    _close_parent(folder, files, compared)


def _in_order(paths: Iterable[Path]) -> list[Path]:
    """By job number: 2 before 10."""
    return sorted(paths, key=lambda path: (len(path.parent.name), path.parent.name))


def _status(folder: Path) -> str:
    return json.loads((folder / RECORD).read_text(encoding="utf-8")).get("status", "")


def _row(path: Path) -> dict[str, Any] | None:
    if _status(path.parent) != "completed":
        return None
    results = json.loads(path.read_text(encoding="utf-8"))
    record = json.loads((path.parent / RECORD).read_text(encoding="utf-8"))
    swept = dict(override.lstrip("+~").split("=", 1) for override in record["overrides"] if "=" in override)
    return {**swept, **results}


def _varied(overrides: Sequence[Sequence[str]]) -> list[str]:
    """The keys that differ between jobs, in the order given."""
    seen: dict[str, set[str]] = {}
    for job in overrides:
        for override in job:
            key, _, value = override.lstrip("+~").partition("=")
            seen.setdefault(key, set()).add(value)
    return [key for key, values in seen.items() if len(values) > 1]


def _picture(rows: Sequence[Mapping[str, Any]], by: Sequence[str], folder: Path) -> list[Path]:
    from framework.pictures import comparison

    if not all("log_likelihood" in row for row in rows):
        return []
    figure = comparison(
        rows,
        "log_likelihood",
        "milliseconds_per_sample",
        title="Log-likelihood against run time",
        synthetic=any(row.get("synthetic") for row in rows),
        x_label="run time (ms per sample)",
        y_label="log-likelihood (nats)",
        group=by[1] if len(by) > 1 else None,
        better="higher",
    )
    path = folder / "comparison.png"
    figure.savefig(path, dpi=110)
    return [path]


def _parent(folder: Path, logger: Mapping[str, Any], run_id: str | None) -> MlflowTracker:
    return MlflowTracker(
        folder,
        uri=logger.get("uri"),
        experiment=logger["experiment"],
        run_name=f"sweep {folder.name}",
        parent=None,
        run_id=run_id,
    )


def _close_parent(folder: Path, files: Sequence[Path], rows: Sequence[Mapping[str, Any]]) -> None:
    path = folder / "parent.json"
    if not path.is_file():
        return
    stored = json.loads(path.read_text(encoding="utf-8"))
    tracker = _parent(folder, stored["logger"], stored["run_id"])
    tracker.open()
    for row in rows:
        numbers = {key: float(value) for key, value in row.items() if isinstance(value, int | float)}
        name = f"{row['method']}/{row['data']}"
        tracker.log_metrics({f"{name}/{key}": value for key, value in numbers.items()}, 0, 0)
    for file in files:
        tracker.log_artifact(file)
    failed = [record for record in folder.glob(f"*/{RECORD}") if _status(record.parent) != "completed"]
    tracker.close("FAILED" if failed else "FINISHED")
