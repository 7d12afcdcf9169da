"""One run: its folder, its tracking, its signals; closed FINISHED, FAILED or KILLED whatever happens."""

import itertools
import os
import shlex
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from framework.configuration.config import Config
from framework.configuration.paths import paths_of, words
from framework.configuration.settings import Settings, store_experiment
from framework.errors import DataError, UserError, encodable
from framework.runs.job import PARENT, SYNCED_WITHIN
from framework.runs.provenance import flatten, package_versions
from framework.runs.repository import git_commit
from framework.storage.files import unwritable, write_whole
from framework.storage.first_rank import first_rank
from framework.storage.plain_values import read_yaml
from framework.tracking.run_info import Destination, read_run_info
from framework.tracking.signals import Stopped, Stopper
from framework.tracking.silent import SilentTracker
from framework.tracking.tracker import MlflowTracker, NoTracker, Tracker
from framework.tracking.watch import watched

TRACEBACK = "traceback.txt"
"""How a run ended that failed or was stopped; gone when it has gone on and finished."""
LEFT_BY_RUNS = (
    "config.yaml",
    "overrides.yaml",
    "checkpoints",
    "figures",
    "results.json",
    "citations.bib",
    "params.json",
    "predictions.csv",
    "work_precision.csv",
    TRACEBACK,
    "unreadable.txt",
)
"""What modes write into a run folder, but for the journal, which the tracker keeps."""
HOW = ("threads", "workers", "logger.uri")
"""Keys that say how a run is run and not what it computes: a resumed one may be given others."""


@dataclass(frozen=True)
class Run:
    """What a mode needs to know of the run it is in."""

    config: Config
    tracker: Tracker
    stopper: Stopper
    resumed: bool

    @property
    def folder(self) -> Path:
        return self.config.folder

    @property
    def settings(self) -> Settings:
        return self.config.settings

    @property
    def checkpoints(self) -> Path:
        return self.folder / "checkpoints"


def stored_config(folder: Path) -> dict[str, Any] | None:
    """The config a run folder was made with; None where there is none yet."""
    path = folder / "config.yaml"
    return read_yaml(path, "the config of a run") if path.is_file() else None


def goes_on(config: Config) -> bool:
    """Whether the run in its folder has the same config, did not finish, and `resume` allows it to go on."""
    earlier = read_run_info(config.folder)
    return (
        earlier is not None
        and earlier.status != "FINISHED"
        and config.settings.resume != "never"
        and _same(stored_config(config.folder), config.values)
    )


@contextmanager
def opened(config: Config) -> Iterator[Run]:
    """Open the run; on the way out close it with the right status.

    Continues the run in its folder where that goes on (`goes_on`); otherwise what that run left is set aside. A rank
    other than the first writes nothing: its run is a silent one.
    """
    stopper = Stopper()
    earlier, resumed = read_run_info(config.folder), goes_on(config)
    if not first_rank():
        with stopper.installed():
            yield Run(config, SilentTracker(config.folder), stopper, resumed)
        return
    config.folder.mkdir(parents=True, exist_ok=True)
    tracker = _tracker(config, earlier.run_id if resumed and earlier else None, resumed)
    with stopper.installed(), watched(config.folder):
        tracker.open()  # from here on the folder is this process's
        run = Run(config, tracker, stopper, resumed)
        try:
            if not resumed:
                _begin_folder(config)
            _describe(run)
            if resumed:  # how it ended before says nothing of how it ends now
                tracker.set_tags({"error": None})
            yield run
        except BaseException as error:
            _record(run, error)
            killed = isinstance(error, KeyboardInterrupt | Stopped)
            tracker.close("KILLED" if killed else "FAILED")
            if killed:
                sys.stderr.write(f"stopped; go on with: python -m framework {going_on(run)}\n")
            if refused := unwritable(error):
                raise DataError(f"{refused} What was written is whole: {going_on(run)} goes on.") from error
            raise
        if resumed:
            (config.folder / TRACEBACK).unlink(missing_ok=True)
        tracker.close("FINISHED")


def going_on(run: Run) -> str:
    """Return what goes on with a run, as typed into a shell."""
    store = run.settings.logger.uri  # a stored address or path is used only where the user says it again
    own = [f"resume={run.folder}", *([f"logger.uri={store}"] if store else [])]
    return " ".join([*map(shlex.quote, own), *words(paths_of(run.config.values))])


def _begin_folder(config: Config) -> None:
    """Leave the config in the folder, and what an earlier run left there in `earlier.<n>`: nothing of it may be
    resumed from, loaded or compared as this one's."""
    folder = config.folder
    left = [folder / name for name in LEFT_BY_RUNS if (folder / name).exists()]
    if left:
        aside = next(path for n in itertools.count(1) if not (path := folder / f"earlier.{n}").exists())
        aside.mkdir()
        for path in left:
            path.replace(aside / path.name)
    (folder / "checkpoints").mkdir()
    write_whole(folder / "overrides.yaml", yaml.safe_dump(list(config.overrides)).encode())
    write_whole(folder / "config.yaml", yaml.safe_dump(dict(config.values), sort_keys=False).encode())


def _same(stored: Mapping[str, Any] | None, values: Mapping[str, Any]) -> bool:
    if stored is None:
        return False
    one, two = (
        {key: value for key, value in flatten(config).items() if key not in ("resume", *HOW)}
        for config in (stored, values)
    )
    return one == two


def _tracker(config: Config, run_id: str | None, resumed: bool) -> Tracker:
    if config.settings.logger.name == "none":
        return NoTracker(config.folder, resumed=resumed)
    parent = os.environ.get(PARENT)
    named = run_name(config.settings, _method(config) or config.mode, config.overrides)
    return MlflowTracker(
        config.folder,
        Destination(
            config.settings.logger.uri,
            store_experiment(config.values, config.trained_on),
            named,
            parent,
            run_id,
        ),
        resumed=resumed,
        wait=0.0 if parent is None else SYNCED_WITHIN,
    )


def _method(config: Config) -> str | None:
    """Return the head that a training without an experiment is called by; None for other runs."""
    head = config.values.get("density_head") if config.mode == "train" else None
    return str(head.get("name")) if isinstance(head, Mapping) else None


def run_name(settings: Settings, method: str, overrides: Sequence[str]) -> str:
    """Return what tells a run from its neighbours.

    That is the method, then what was changed on the command line, then the seed. Up to the first comma it is also the
    name of the run's model in the store.

    Args:
        method: of a run without an experiment.
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
    run.tracker.log_params(flatten(config.values))
    run.tracker.log_artifact(run.folder / "config.yaml")
    run.tracker.log_artifact(run.folder / "overrides.yaml")


def _record(run: Run, error: BaseException) -> None:
    """Leave the traceback and the sentence with the run."""
    path = run.folder / TRACEBACK
    with suppress(OSError):  # of a full disk there is no more to be said than the error itself
        write_whole(path, encodable("".join(traceback.format_exception(error))).encode())
        run.tracker.log_artifact(path)
    sentence = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
    if isinstance(error, Stopped):
        sentence = f"stopped by {error.signal}"
    run.tracker.set_tags({"error": sentence[:5000]})
