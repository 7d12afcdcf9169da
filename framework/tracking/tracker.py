"""Recording of a run, to the local journal immediately and to a store as soon as the store accepts the entries."""

import importlib
import json
import logging
import os
import shlex
import shutil
import time
import uuid
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, final

from framework.errors import DataError
from framework.storage.files import write_whole
from framework.storage.plain_values import read_json
from framework.tracking.journal import Journal
from framework.tracking.run_info import SIDECAR, Destination, RunInfo, Sidecar, read_run_info
from framework.tracking.sender import OpenStore, Sender
from framework.tracking.store_process import take_process
from framework.tracking.stores import without_password

_log = logging.getLogger(__name__)

Status = Literal["FINISHED", "FAILED", "KILLED"]

JOURNAL = "journal.jsonl"
ELSEWHERE = "elsewhere"  # folder for copies of logged files that lie outside the run folder
LONGEST_PARAMETER = 250  # characters; some servers cut off the rest silently


class Tracker(ABC):
    """Contract of the object that records one run.

    Only one process records a run; the other processes of a distributed training record nothing. `open` is called first
    and `close` last. Between these calls, no method raises an error or waits because of a store: when the call returns,
    the entry is in the journal (metrics take at most a tenth of a millisecond), and it reaches the store later. Steps
    are optimiser steps; names have the form "validation/loss".
    """

    journal: Journal

    @abstractmethod
    def open(self) -> None:
        """Begin or continue the run, and set its status to RUNNING.

        Raises:
            DataError: The run folder cannot be written, or another process writes to it.
        """

    @abstractmethod
    def log_params(self, flat: Mapping[str, object]) -> None:
        """Record the config by dotted keys; a later change of a value is recorded as the tag `changed.<key>`."""

    @abstractmethod
    def set_tags(self, tags: Mapping[str, str | None]) -> None:
        """Record texts that describe the run, by name; a new text replaces the earlier one, and None removes it."""

    @abstractmethod
    def log_metrics(self, values: Mapping[str, float], step: int, epoch: int) -> None:
        """Record numbers by name, which may be NaN or infinite, with the optimiser step and the epoch."""

    @abstractmethod
    def log_dataset(self, name: str, context: str, facts: Mapping[str, str]) -> None:
        """Record a data set with its use, such as "training", and the facts that `Data.fingerprint` returns."""

    @abstractmethod
    def log_artifact(self, path: Path, folder: str = "") -> None:
        """Record a file or directory, to be stored under `folder`; it is read later and must stay where it is.

        With `folder=run_info.MODEL`, the file is a checkpoint and becomes the model of the run, which the store can
        serve.
        """

    @abstractmethod
    def drop_after(self, step: int) -> None:
        """Remove the metrics after `step`, because the run is resumed from there and will repeat them."""

    @abstractmethod
    def close(self, status: Status) -> None:
        """Wait a limited time until the store has accepted the remaining entries, and end the run."""

    @abstractmethod
    def leave_open(self) -> None:
        """Release the run like `close`, but set no final status, because another tracker will continue the run."""

    @property
    @abstractmethod
    def run_id(self) -> str | None:
        """Return the id of the run in the store; None without a store, or before the store was reached."""

    @property
    @abstractmethod
    def url(self) -> str:
        """Return where the user sees the run: the address of a page, a command to type, or the journal's path."""


@final
class NoTracker(Tracker):
    """Tracker that keeps the journal of metrics and nothing else.

    Args:
        folder: Folder of the run.
        resumed: Whether to continue the journal in the folder instead of renaming it; None continues the journal if its
            run has not finished.
    """

    def __init__(self, folder: Path, *, resumed: bool | None = None) -> None:
        self.folder = folder
        self.journal = Journal(folder / JOURNAL)
        self._resumed = resumed
        self._sidecar: Sidecar | None = None

    def open(self) -> None:
        info = RunInfo(None, "", "", "", None, None, uuid.uuid4().hex, time.time(), "RUNNING")
        self._sidecar = _begin_run(self.folder, self.journal, info, self._resumed)

    def log_params(self, flat: Mapping[str, object]) -> None:
        """Do nothing, because the config is in the run folder."""

    def set_tags(self, tags: Mapping[str, str | None]) -> None:
        """Do nothing, because tags only serve to find runs in a store."""

    def log_metrics(self, values: Mapping[str, float], step: int, epoch: int) -> None:
        self.journal.write(values, step, epoch)

    def log_dataset(self, name: str, context: str, facts: Mapping[str, str]) -> None:
        """Do nothing, because recorded data sets only serve to find runs in a store."""

    def log_artifact(self, path: Path, folder: str = "") -> None:
        """Do nothing, because the file stays in the run folder."""

    def drop_after(self, step: int) -> None:
        self.journal.drop_after(step)

    def close(self, status: Status) -> None:
        if self._sidecar is not None:
            self._sidecar.update(status=status)
        self.journal.close()

    def leave_open(self) -> None:
        self.journal.close()

    @property
    def run_id(self) -> None:
        return None

    @property
    def url(self) -> str:
        return str(self.journal.path)


@final
class MlflowTracker(Tracker):
    """Tracker that sends a run to an MLflow store in batches, from a separate process.

    Every entry is a line of the journal, and the store receives a copy of the journal. A thread sends new lines when 50
    of them wait or two seconds have passed. If the store is locked, full or cannot be reached, the thread tries again
    without end, at growing intervals (up to 30 s). `sync` sends the lines that the process could not send before it
    ended. Lines that the store has received are not sent again: a resumed run repeats the steps after its checkpoint,
    and the store keeps the first values of these steps.

    The import of MLflow takes several seconds. A short run can avoid this import if another process, such as a sweep,
    calls `sync` afterwards: nothing is sent in the first `wait` seconds.

    Args:
        folder: Folder of the run.
        destination: Run and store to send to.
        resumed: Whether to continue the run in the folder instead of renaming its files; None continues the run if it
            is the run of the destination.
        wait: Seconds after opening before the first line is sent; a run that ends sooner sends nothing.
        opening_patience: Seconds that `open` waits for the store, for a caller that needs the run's id immediately.
        patience: Seconds that `close` waits for the store.
        open_store: Function that opens the run in the store; None uses a separate process.

    Raises:
        ConfigError: MLflow cannot keep runs in the store of the destination.
    """

    def __init__(
        self,
        folder: Path,
        destination: Destination,
        *,
        resumed: bool | None = None,
        wait: float = 0.0,
        opening_patience: float = 0.0,
        patience: float = 60.0,
        open_store: OpenStore | None = None,
    ) -> None:
        self.folder = folder.absolute()
        self.journal = Journal(self.folder / JOURNAL)
        self._wanted = RunInfo.at(destination, self.folder)
        self._resumed = resumed
        self._patience = patience
        self._opening_patience = opening_patience
        self._sends_from = time.monotonic() + wait if wait else 0.0
        self._process = take_process() if open_store is None else None
        self._open_store = open_store or self._process
        self._sidecar: Sidecar | None = None
        self._sender: Sender | None = None
        self._closed = False

    def open(self) -> None:
        self._closed = False
        self._sidecar = _begin_run(self.folder, self.journal, self._wanted, self._resumed)
        self.journal.append(status="RUNNING")
        self._notice()

    def _start_sending(self, sidecar: Sidecar) -> None:
        assert self._open_store is not None
        self._sender = Sender(self.folder, self.journal, sidecar, self._open_store)
        self._sender.start()
        if self._opening_patience and not self._sender.tried.wait(self._opening_patience):
            self._sender.warn("the store has not responded yet")

    def log_params(self, flat: Mapping[str, object]) -> None:
        shown = {key: str(value) for key, value in flat.items()}
        long = {key: value for key, value in shown.items() if len(value) > LONGEST_PARAMETER}
        if long:
            shown |= {key: value[: LONGEST_PARAMETER - 1] + "…" for key, value in long.items()}
            self._save_long_parameters(long)
        self._log(params=shown)

    def set_tags(self, tags: Mapping[str, str | None]) -> None:
        self._log(tags=dict(tags))

    def log_metrics(self, values: Mapping[str, float], step: int, epoch: int) -> None:
        self.journal.write(values, step, epoch)
        self._notice()

    def log_dataset(self, name: str, context: str, facts: Mapping[str, str]) -> None:
        self._log(dataset=name, context=context, facts=dict(facts))

    def log_artifact(self, path: Path, folder: str = "") -> None:
        path = path.absolute()
        if not path.is_relative_to(
            self.folder
        ):  # a run folder may be moved, and only files inside it are sent
            copy = self.folder / ELSEWHERE / path.name
            copy.parent.mkdir(exist_ok=True)
            shutil.copytree(path, copy, dirs_exist_ok=True) if path.is_dir() else shutil.copy2(path, copy)
            path = copy
        self._log(artifact=str(path.relative_to(self.folder)), folder=folder)

    def drop_after(self, step: int) -> None:
        self.journal.drop_after(step)

    def close(self, status: Status) -> None:
        if self._sidecar is not None and not self._closed:
            self.journal.append(status=status)
            self._sidecar.update(status=status)
        self.leave_open()

    def leave_open(self) -> None:
        if self._sidecar is None or self._closed:
            return
        self._closed = True
        if self._sender is not None and not self._sender.finish(self._patience):
            _log.warning(
                "Part of this run has not reached the tracking store %s. The missing entries are in %s; "
                "`python -m framework mode=sync mode.run=%s` sends them.",
                without_password(self._sidecar.info.uri),
                self.journal.path,
                shlex.quote(str(self.folder)),
            )
        if self._process is not None:
            self._process.end(at_once=self._sender is not None and self._sender.is_alive())
        self._sender = None
        self.journal.close()

    def _save_long_parameters(self, params: dict[str, str]) -> None:
        path = self.folder / "params.json"
        try:
            earlier = read_json(path, "parameters") if os.path.lexists(path) else {}
            write_whole(path, json.dumps({**earlier, **params}, indent=1).encode())
        except (OSError, DataError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            _log.warning(
                "Parameters that are too long for the store could not be written to %s: %s", path, why
            )
        else:
            self.log_artifact(path)

    def _log(self, **record: Any) -> None:
        self.journal.append(**record)
        self._notice()

    def _notice(self) -> None:
        """Notify the sender that one more line waits; start the sender if the time `wait` after opening is over."""
        if self._sender is None and self._sidecar is not None and not self._closed:
            if time.monotonic() >= self._sends_from:
                self._start_sending(self._sidecar)
        elif self._sender is not None:
            self._sender.notice()

    @property
    def run_id(self) -> str | None:
        return self._sidecar.info.run_id if self._sidecar else self._wanted.run_id

    @property
    def url(self) -> str:
        info = self._sidecar.info if self._sidecar else self._wanted
        if not info.uri.startswith("http"):
            return f"mlflow ui --backend-store-uri {shlex.quote(without_password(info.uri))}"
        base = without_password(info.uri).rstrip("/")
        return f"{base}/#/experiments/{info.experiment_id}/runs/{info.run_id}" if info.run_id else base


def _begin_run(folder: Path, journal: Journal, new_info: RunInfo, resumed: bool | None) -> Sidecar:
    """Open a run folder for writing, and return the record of the run that continues or begins there.

    If the run in the folder is not continued, its files are renamed.
    """
    earlier = read_run_info(folder)
    journal.open(after=earlier.sent if earlier else 0)
    if earlier is not None and _continues(earlier, new_info, resumed):
        info = replace(
            new_info,
            run_id=new_info.run_id or earlier.run_id,
            key=earlier.key,
            started=earlier.started,
            experiment_id=earlier.experiment_id,
        )
        store_and_run = (without_password(info.uri), info.run_id)
        # another store has no lines of this run yet, so it must get all of them
        if (without_password(earlier.uri), earlier.run_id) == store_and_run:
            info = replace(
                info,
                sent=earlier.sent,
                owed=earlier.owed,
                replay_after=earlier.replay_after,
                replay_until=earlier.replay_until,
            )
    else:
        info = new_info
        if earlier is not None or journal.last:
            number = next(k for k in range(1, 1 << 30) if not (folder / f"journal.{k}.jsonl").exists())
            if earlier is not None:
                (folder / SIDECAR).replace(folder / f"run.{number}.json")
            journal.set_aside(folder / f"journal.{number}.jsonl")
    sidecar = Sidecar(folder, info)
    sidecar.update()
    return sidecar


def _continues(earlier: RunInfo, new_info: RunInfo, resumed: bool | None) -> bool:
    if resumed is not None:
        return resumed
    if new_info.run_id is not None:
        return new_info.run_id == earlier.run_id
    return earlier.run_id is None and earlier.status != "FINISHED"


def mlflow_store() -> OpenStore:
    """Import MLflow, and return the class that opens a run in an MLflow store."""
    return importlib.import_module("framework.tracking.mlflow_store").MlflowStore
