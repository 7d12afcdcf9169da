"""Parent run of a sweep, and the table and the figure that compare the sweep's jobs."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from framework.configuration.modes import MODES
from framework.configuration.paths import flatten
from framework.configuration.settings import store_experiment
from framework.errors import UserError, count_of
from framework.reports.table import markdown, results_table, write_csv
from framework.runs.job import find_job_folders, find_members, read_record
from framework.runs.resuming import stored_config
from framework.storage.progress import output
from framework.sweeps.jobs import runs_elsewhere
from framework.sweeps.results import Comparison, compare, comparison_figure, job_results
from framework.tracking.ended import close_and_send
from framework.tracking.run_info import Destination, RunInfo, read_run_info
from framework.tracking.tracker import MlflowTracker, mlflow_store

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DESCRIPTION, LONGEST_DESCRIPTION = "mlflow.note.content", 7500
"""Tag that MLflow shows as a run's description, and the largest number of characters of a description."""


def begin(folder: Path, config: Mapping[str, Any]) -> str | None:
    """Open the parent run of a sweep's jobs in the tracking store, and return its id; None without a store.

    Args:
        folder: Folder of the sweep.
        config: Composed config of the first job.
    """
    logger = config.get("logger") or {}
    if logger.get("name") != "mlflow":
        return None
    # not None if a sweep is repeated in this folder; the earlier sweep may have been killed
    earlier = read_run_info(folder)
    tracker = _parent(folder, config, earlier, experiment_of(config))
    tracker.open()
    tracker.set_tags({"mode": "sweep", "folder": str(folder), DESCRIPTION: f"A sweep in `{folder}`."})
    run_id = tracker.run_id
    tracker.leave_open()
    return run_id


def experiment_of(config: Mapping[str, Any]) -> str:
    """Return the experiment of a sweep's jobs in the tracking store; it may depend on the stored model that they use.

    Args:
        config: Composed config of the first job.
    """
    mode = config.get("mode") or {}
    name = str(mode.get("name"))
    if not (name in MODES and MODES[name].stored):
        return store_experiment(config)
    try:
        members = mode.get("members")
        model = find_members(members)[0] if isinstance(members, str | list) else config.get("checkpoint")
        if model is None:
            return store_experiment(config)
        from framework.configuration.loading import read_stored  # imports torch, which few sweeps need here

        stored = flatten(config.get("stored") or {})
        description, _ = read_stored(model, uri=store_of(config), paths=stored)
    except UserError:  # the jobs report the error
        return store_experiment(config)
    experiment = config.get("experiment_name") or description.settings.get("experiment_name")
    return store_experiment({**config, "experiment_name": experiment}, description.config["data"]["name"])


def summarise(folder: Path, overrides: Sequence[Sequence[str]], config: Mapping[str, Any]) -> None:
    """Compare the finished jobs in `folder`: print the table, and log it and a figure to the parent run.

    Args:
        folder: Folder of the sweep.
        overrides: Overrides of each job of this command.
        config: Composed config of the first job; no store but the one that it names is contacted.
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

        title = f"{count_of(len(compared.runs), 'run')} in {folder}"
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
        summary = f"{count_of(len(compared.runs), 'run')} over {varied}.\n\n{table}"
    close_parent(folder, files, summary, config)


def store_of(config: Mapping[str, Any]) -> str | None:
    """Return the address of the store that a sweep's command names; None if it names none."""
    uri = (config.get("logger") or {}).get("uri")
    return None if uri is None else str(uri)


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


def close_parent(folder: Path, files: Sequence[Path], summary: str, config: Mapping[str, Any]) -> None:
    """Log files and a description to the parent run of a sweep, and close the run; do nothing without a parent run.

    Args:
        folder: Folder of the sweep.
        files: Files to log.
        summary: Text for the description of the run; "" leaves the description unchanged.
        config: Composed config of the first job.
    """
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
    if any(map(runs_elsewhere, records)):
        tracker.leave_open()  # jobs of an engine go on without this command
    else:
        completed = all(record.get("status") == "completed" for record in records)
        tracker.close("FINISHED" if completed else "FAILED")
