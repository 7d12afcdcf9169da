"""Further formats in which the numbers of a run are written beside its journal: CSV, TensorBoard, Weights & Biases.

Nothing leaves the machine by default. Files of CSV and TensorBoard are in the run folder. Weights & Biases writes its
files below `outputs`, and sends nothing (`WANDB_MODE=offline`) unless the user sets WANDB_MODE.
"""

import csv
import hashlib
import importlib
import io
import logging
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, final

from framework.errors import ConfigError
from framework.storage.enclosed import require_plain_within
from framework.storage.files import write_whole
from framework.storage.text import defuse_formulas
from framework.storage.working_directory import refuse_settings
from framework.tracking.journal import Journal
from framework.tracking.tracker import Status, Tracker

_log = logging.getLogger(__name__)

Form = Literal["csv", "tensorboard", "wandb"]
PACKAGES: Mapping[Form, str] = {"tensorboard": "tensorboard", "wandb": "wandb"}
WANDB_PARENT = Path("outputs")
"""Folder in which wandb makes its own folder, unless the environment variable WANDB_DIR names another one."""
"""Package that a format needs; the extra of this project with the name of the format installs it."""


def require_packages(forms: Sequence[Form]) -> None:
    """Refuse a format whose package is not installed, or would read settings from the working directory.

    Raises:
        ConfigError: The package is missing, the working directory contains a settings file of wandb, or a link takes
            the place of the folder to which wandb writes.
    """
    if "wandb" in forms:
        refuse_settings(("wandb",))
        if "WANDB_DIR" not in os.environ:
            for name in ("wandb", ".wandb"):  # wandb writes to the second if it exists
                require_plain_within(WANDB_PARENT / name, WANDB_PARENT, ConfigError)
    for form in forms:
        if form in PACKAGES and find_spec(PACKAGES[form]) is None:
            raise ConfigError(
                f"logger={form} needs the package {PACKAGES[form]}, which is not installed. Run `pip install "
                f"'robust-visual-learning[{form}]'`, or leave {form} out."
            )


class Copy(ABC):
    """Contract of a further format in which the numbers of a run are written.

    `CopyingTracker` calls the methods after it has written the journal. An error ends the copy, and never the run.

    Args:
        folder: Folder of the run.
        name: Name of the run.
        project: Name of the experiment.
    """

    def __init__(self, folder: Path, name: str, project: str) -> None:
        self.folder = folder
        self.name = name
        self.project = project

    @abstractmethod
    def log_params(self, flat: Mapping[str, object]) -> None:
        """Record the config by dotted keys."""

    @abstractmethod
    def log_metrics(self, values: Mapping[str, float], step: int, epoch: int) -> None:
        """Record numbers by name, with the optimiser step and the epoch."""

    @abstractmethod
    def drop_after(self, step: int) -> None:
        """Remove the metrics after `step`, which a resumed run repeats."""

    @abstractmethod
    def close(self, status: Status, journal: Journal) -> None:
        """Write the numbers that are still missing, and close the files.

        Args:
            status: Status with which the run ended.
            journal: Journal with all numbers of the run.
        """


@final
class CsvCopy(Copy):
    """File `metrics.csv`, which is made from the journal when the run ends: one row for each entry of the journal."""

    def log_params(self, flat: Mapping[str, object]) -> None:
        """Do nothing, because the config is in the run folder."""

    def log_metrics(self, values: Mapping[str, float], step: int, epoch: int) -> None:
        """Do nothing, because `close` reads the journal."""

    def drop_after(self, step: int) -> None:
        """Do nothing, because `close` reads the journal."""

    def close(self, status: Status, journal: Journal) -> None:
        lines = list(journal.lines())
        names = dict.fromkeys(name for line in lines for name in line.values)
        text = io.StringIO()
        writer = csv.DictWriter(text, ["step", "epoch", "time", *names])
        writer.writerow({name: defuse_formulas(name) for name in writer.fieldnames})
        for line in lines:
            writer.writerow({"step": line.step, "epoch": line.epoch, "time": line.time, **line.values})
        write_whole(self.folder / "metrics.csv", text.getvalue().encode())


@final
class TensorBoardCopy(Copy):
    """Folder `tensorboard` with event files, which `tensorboard --logdir outputs` shows while the run goes on."""

    _writer: Any = None

    def _open(self, after: int | None = None) -> Any:
        if self._writer is None:
            module = importlib.import_module("torch.utils.tensorboard")
            purge = None if after is None else after + 1
            self._writer = module.SummaryWriter(str(self.folder / "tensorboard"), purge_step=purge)
        return self._writer

    def log_params(self, flat: Mapping[str, object]) -> None:
        self._open().add_text("config", "\n".join(f"    {key}: {value}" for key, value in flat.items()))

    def log_metrics(self, values: Mapping[str, float], step: int, epoch: int) -> None:
        writer = self._open()
        for name, value in values.items():
            writer.add_scalar(name, value, step)

    def drop_after(self, step: int) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None
        self._open(step)

    def close(self, status: Status, journal: Journal) -> None:
        if self._writer is not None:
            self._writer.add_text("status", status)
            self._writer.close()
            self._writer = None


@final
class WandbCopy(Copy):
    """Run of Weights & Biases in `outputs/wandb`, offline unless the user sets WANDB_MODE.

    The files are not in the run folder, because wandb writes links, which commands that read a run folder refuse.
    """

    _run: Any = None
    _last = 0

    def _open(self) -> Any:
        if self._run is None:
            os.environ.setdefault("WANDB_MODE", "offline")
            os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
            wandb = importlib.import_module("wandb")
            folder = Path(os.environ.get("WANDB_DIR", WANDB_PARENT))
            folder.mkdir(parents=True, exist_ok=True)
            self._run = wandb.init(
                dir=str(folder),
                project=self.project,
                name=self.name,
                id=hashlib.sha256(str(self.folder.absolute()).encode()).hexdigest()[:16],
                resume="allow",
                settings=wandb.Settings(silent=True, console="off", disable_code=True, disable_git=True),
            )
        return self._run

    def log_params(self, flat: Mapping[str, object]) -> None:
        self._open().config.update({key: str(value) for key, value in flat.items()}, allow_val_change=True)

    def log_metrics(self, values: Mapping[str, float], step: int, epoch: int) -> None:
        if step < self._last:  # results of the test, which belong to the whole run; steps may only grow
            self._open().summary.update(dict(values))
            return
        self._last = step
        self._open().log({**values, "epoch": epoch}, step=step)

    def drop_after(self, step: int) -> None:
        """Do nothing, because Weights & Biases keeps the first values of a step."""

    def close(self, status: Status, journal: Journal) -> None:
        if self._run is not None:
            self._run.finish(exit_code=0 if status == "FINISHED" else 1)
            self._run = None


COPIES: Mapping[Form, type[Copy]] = {"csv": CsvCopy, "tensorboard": TensorBoardCopy, "wandb": WandbCopy}


@final
class CopyingTracker(Tracker):
    """Tracker that records a run by another tracker, and also in further formats such as CSV or TensorBoard.

    Args:
        tracker: Tracker that writes the journal.
        copies: One writer for each further format.
    """

    def __init__(self, tracker: Tracker, copies: Sequence[Copy]) -> None:
        self.tracker = tracker
        self.journal = tracker.journal
        self._copies = list(copies)

    def open(self) -> None:
        self.tracker.open()

    def log_params(self, flat: Mapping[str, object]) -> None:
        self.tracker.log_params(flat)
        self._call_copies(lambda copy: copy.log_params(flat))

    def set_tags(self, tags: Mapping[str, str | None]) -> None:
        self.tracker.set_tags(tags)

    def log_metrics(self, values: Mapping[str, float], step: int, epoch: int) -> None:
        self.tracker.log_metrics(values, step, epoch)
        self._call_copies(lambda copy: copy.log_metrics(values, step, epoch))

    def log_dataset(self, name: str, context: str, facts: Mapping[str, str]) -> None:
        self.tracker.log_dataset(name, context, facts)

    def log_artifact(self, path: Path, folder: str = "") -> None:
        self.tracker.log_artifact(path, folder)

    def drop_after(self, step: int) -> None:
        self.tracker.drop_after(step)
        self._call_copies(lambda copy: copy.drop_after(step))

    def close(self, status: Status) -> None:
        self._call_copies(lambda copy: copy.close(status, self.journal))
        self.tracker.close(status)

    def leave_open(self) -> None:
        self.tracker.leave_open()

    @property
    def run_id(self) -> str | None:
        return self.tracker.run_id

    @property
    def url(self) -> str:
        return self.tracker.url

    def _call_copies(self, act: Callable[[Copy], None]) -> None:
        """Call `act` with every copy; a copy that fails is left out from then on, with a warning."""
        for copy in list(self._copies):
            try:
                act(copy)
            except Exception as error:
                self._copies.remove(copy)
                _log.warning(
                    "%s stopped: %s: %s. The journal %s has all numbers.",
                    type(copy).__name__,
                    type(error).__name__,
                    error,
                    self.journal.path,
                )
