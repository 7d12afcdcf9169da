"""Run with its folder, tracking and signals; it is always closed with the status FINISHED, FAILED or KILLED."""

import itertools
import os
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import yaml

from framework.configuration.config import Config
from framework.configuration.settings import Settings, store_experiment
from framework.errors import DataError, UserError, escape_undecodable
from framework.runs.job import PARENT, SYNCED_WITHIN
from framework.runs.provenance import flatten, package_versions
from framework.runs.repository import git_commit
from framework.runs.resuming import may_resume, resume_arguments
from framework.storage.files import describe_unwritable, write_whole
from framework.storage.first_rank import first_rank
from framework.tracking.run_info import Destination, read_run_info
from framework.tracking.signals import Stopped, Stopper
from framework.tracking.silent import SilentTracker
from framework.tracking.tracker import MlflowTracker, NoTracker, Tracker
from framework.tracking.watch import start_watcher

TRACEBACK = "traceback.txt"
"""File with the traceback of a run that failed or was stopped; it is removed when the run is resumed and finishes."""
PROFILE = "fit-profile.txt"
"""File with the report of the profiler of a training (`trainer.profiler`); Lightning gives it this name."""
RANGE_TEST = "learning_rate.json"
"""File with the losses of the range test and the learning rate that was found (`optimizer.learning_rate=auto`)."""
LEFT_BY_RUNS = (
    "config.yaml",
    "overrides.yaml",
    "checkpoints",
    "figures",
    "images",
    "results.json",
    "citations.bib",
    "params.json",
    "predictions.csv",
    "work_precision.csv",
    TRACEBACK,
    "unreadable.txt",
    PROFILE,
    RANGE_TEST,
    "metrics.csv",
    "tensorboard",
    "wandb",
)
"""Files and folders that modes write into a run folder; the tracker writes the journal in addition."""


@dataclass(frozen=True)
class Run:
    """Objects of a run in progress, which a mode receives.

    Attributes:
        config: Config of the command.
        tracker: Tracker that records the run.
        stopper: Handler of the signals that stop the run.
        resumed: Whether the run continues an earlier one in its folder.
    """

    config: Config
    tracker: Tracker
    stopper: Stopper
    resumed: bool

    @property
    def folder(self) -> Path:
        """Return the folder of the run."""
        return self.config.folder

    @property
    def settings(self) -> Settings:
        """Return the settings of the run."""
        return self.config.settings

    @property
    def checkpoints(self) -> Path:
        """Return the folder of the run's checkpoints."""
        return self.folder / "checkpoints"


@contextmanager
def open_run(config: Config) -> Iterator[Run]:
    """Open the run of a command for the `with` block, then close it.

    The run is closed as FINISHED, FAILED or KILLED, depending on how the block ended.

    The run in the folder is continued if `may_resume` returns True; otherwise the files of that run are moved to a
    subfolder. A rank other than the first writes nothing and gets a silent tracker.
    """
    stopper = Stopper()
    earlier, resumed = read_run_info(config.folder), may_resume(config)
    if not first_rank():
        try:
            with stopper.installed():
                yield Run(config, SilentTracker(config.folder), stopper, resumed)
        finally:
            # Hydra has made a folder for each process, unless the command names one
            with suppress(OSError):
                config.folder.rmdir()
        return
    config.folder.mkdir(parents=True, exist_ok=True)
    tracker = _tracker(config, earlier.run_id if resumed and earlier else None, resumed)
    with stopper.installed(), start_watcher(config.folder):
        tracker.open()  # from here on, only this process writes to the folder
        run = Run(config, tracker, stopper, resumed)
        try:
            if not resumed:
                _begin_folder(config)
            _describe(run)
            if resumed:  # the earlier error no longer describes the run
                tracker.set_tags({"error": None})
            yield run
        except BaseException as error:
            _record_error(run, error)
            killed = isinstance(error, KeyboardInterrupt | Stopped)
            tracker.close("KILLED" if killed else "FAILED")
            if killed:
                sys.stderr.write(f"stopped; continue with: python -m framework {resume_arguments(run)}\n")
            if refused := describe_unwritable(error):
                raise DataError(
                    f"{refused} All files of the run are undamaged. Continue the run with {resume_arguments(run)}."
                ) from error
            raise
        if resumed:
            (config.folder / TRACEBACK).unlink(missing_ok=True)
        tracker.close("FINISHED")


def _begin_folder(config: Config) -> None:
    """Write the config into the folder, after moving the files of an earlier run to `earlier.<n>`.

    The files are moved, so that no command resumes, loads or compares them as files of the new run.
    """
    folder = config.folder
    earlier_files = [folder / name for name in LEFT_BY_RUNS if (folder / name).exists()]
    if earlier_files:
        aside = next(path for n in itertools.count(1) if not (path := folder / f"earlier.{n}").exists())
        aside.mkdir()
        for path in earlier_files:
            path.replace(aside / path.name)
    (folder / "checkpoints").mkdir()
    write_whole(folder / "overrides.yaml", yaml.safe_dump(list(config.overrides)).encode())
    write_whole(folder / "config.yaml", yaml.safe_dump(config.settings.plain(), sort_keys=False).encode())


def _tracker(config: Config, run_id: str | None, resumed: bool) -> Tracker:
    logger = config.settings.logger
    name = run_name(config.settings, _method(config) or config.mode, config.overrides)
    experiment = store_experiment(config.settings.plain(), config.trained_on)
    tracker: Tracker
    if logger.name == "none":
        tracker = NoTracker(config.folder, resumed=resumed)
    else:
        parent = os.environ.get(PARENT)
        tracker = MlflowTracker(
            config.folder,
            Destination(logger.uri, experiment, name, parent, run_id),
            resumed=resumed,
            wait=0.0 if parent is None else SYNCED_WITHIN,
        )
    if not logger.copies:
        return tracker
    from framework.tracking.copies import COPIES, CopyingTracker

    copies = [COPIES[form](config.folder, name, experiment) for form in dict.fromkeys(logger.copies)]
    return CopyingTracker(tracker, copies)


def _method(config: Config) -> str | None:
    """Return the name of the density head, by which a training without an experiment is named; None in other modes."""
    head = config.settings.density_head if config.mode == "train" else None
    return str(head.get("name")) if isinstance(head, Mapping) else None


def run_name(settings: Settings, method: str, overrides: Sequence[str]) -> str:
    """Return a name that distinguishes a run from similar ones.

    The name consists of the method, the overrides on the command line, and the seed. The part before the first comma is
    also the name of the run's model in the store.

    Args:
        settings: Settings of the run.
        method: Name of the method, for a run without an experiment.
        overrides: Overrides on the command line.
    """
    parts = [(settings.experiment_name or method).rpartition("/")[2]]
    for override in overrides:
        key, _, value = override.lstrip("+~").partition("=")
        if key.partition(".")[0] not in (
            "experiment",
            "seed",
            "threads",
            "logger",
            "mode",
            "hydra",
            "workers",
        ):
            parts.append(f"{key.rpartition('.')[2]}={value}")
    return ", ".join([*parts, f"seed={settings.seed}"])[:200]


def _describe(run: Run) -> None:
    config = run.config
    tags = {f"git.{key}": str(value) for key, value in git_commit(Path.cwd()).items()}
    tags |= {f"version.{key}": value for key, value in package_versions().items()}
    tags |= {"mode": config.mode, "overrides": " ".join(config.overrides), "folder": str(run.folder)}
    run.tracker.set_tags(tags)
    run.tracker.log_params(flatten(config.settings.plain()))
    run.tracker.log_artifact(run.folder / "config.yaml")
    run.tracker.log_artifact(run.folder / "overrides.yaml")


def _record_error(run: Run, error: BaseException) -> None:
    """Store the traceback in the run folder, and the error message as a tag of the run."""
    path = run.folder / TRACEBACK
    with suppress(OSError):  # on a full disk, only the error itself can be reported
        write_whole(path, escape_undecodable("".join(traceback.format_exception(error))).encode())
        run.tracker.log_artifact(path)
    sentence = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
    if isinstance(error, Stopped):
        sentence = f"stopped by {error.signal}"
    run.tracker.set_tags({"error": sentence[:5000]})
