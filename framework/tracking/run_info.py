"""Record of a run in `run.json`: its store, how much of the journal was sent, and how the run ended."""

import json
import logging
import os
import threading
import time
import uuid
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter

from framework.storage.enclosed import read_plain
from framework.storage.files import write_whole
from framework.storage.plain_values import LARGEST_JSON
from framework.storage.reading import translate_errors
from framework.tracking.stores import Address, address, artifact_folder, require_own_files, without_password

_log = logging.getLogger(__name__)

SIDECAR = "run.json"
MODEL = "model:"
"""Value of `folder` in `Tracker.log_artifact` for a checkpoint that the store keeps as the model of the run.

With any other value, the store keeps the checkpoint as a file.
"""


@dataclass(frozen=True)
class Destination:
    """Store to which a run is sent, and the experiment, name and parent that the run has there.

    Attributes:
        uri: MLflow tracking URI that the user names; None means the default of `stores.address`.
        experiment: Name of the experiment in MLflow, which is created if it is new.
        run_name: Name of the run in MLflow.
        parent: Id of the run under which MLflow shows this one.
        run_id: Id of the run to continue; None means a new run, or the run in the folder if that run has no id yet.
    """

    uri: str | None
    experiment: str
    run_name: str
    parent: str | None = None
    run_id: str | None = None


@dataclass(frozen=True)
class RunInfo:
    """Content of `run.json` in the run folder, which suffices to continue the run from another process."""

    run_id: str | None
    """Id of the run in the store; None while the store has not been reached."""
    uri: str
    """Address of the store, written to the file without a password; empty if the run has no store."""
    experiment: str
    run_name: str
    parent: str | None
    """Id of the run, such as a sweep, to which this run belongs in the store."""
    artifacts: str | None
    """Folder for the files of a new experiment; None lets the store decide."""
    key: str
    """Id that the framework creates for the run; it finds the run in the store even if `run_id` was never received."""
    started: Annotated[float, Field(ge=0, le=1e11)]
    """Start of the run, in seconds since 1970."""
    status: str
    """Status of the run: RUNNING, FINISHED, FAILED or KILLED."""
    experiment_id: str | None = None
    sent: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Number of the last journal line up to which the store has all lines."""
    replay_after: Annotated[int, Field(ge=0, lt=2**63)] | None = None
    """Step from which the run was last resumed; the run repeats the steps after it."""
    replay_until: dict[str, int] = field(default_factory=dict)
    """Last step of each metric that the store had when the run was resumed; repeated steps up to it are not sent."""
    owed: tuple[tuple[str, str], ...] = ()
    """Files (path, folder in the store) that must still be sent to the store."""
    named: bool = False
    """True if the user named the store (`stores.Address`); this value is never read from a file."""

    @classmethod
    def at(cls, place: Destination, folder: Path) -> "RunInfo":
        """Return the record of a new run in `folder`, which is sent to `place`.

        Raises:
            ConfigError: MLflow cannot keep runs in the store `place.uri`.
            DataError: A file of the default store is a link that leads out of its folder.
        """
        store = address(place.uri, folder)
        if not store.named:
            require_own_files(store.uri)
        return cls(
            place.run_id,
            store.uri,
            place.experiment,
            place.run_name,
            place.parent,
            artifact_folder(store.uri, folder),
            uuid.uuid4().hex,
            time.time(),
            "RUNNING",
            named=store.named,
        )

    def at_store(self, store: Address, folder: Path) -> "RunInfo":
        """Return this record, of the run in `folder`, with `store` as its store; the user gave this address."""
        return replace(self, uri=store.uri, named=store.named, artifacts=artifact_folder(store.uri, folder))


def read_run_info(folder: Path) -> RunInfo | None:
    """Return the content of `run.json` in a run folder, or None if there is no such file.

    Raises:
        DataError: The content was not written by a tracker.
    """
    path = folder / SIDECAR
    if not os.path.lexists(path):
        return None
    with translate_errors(path, "the record of a run", "Remove the file; the run then begins again."):
        info = TypeAdapter(RunInfo).validate_json(read_plain(path, LARGEST_JSON), strict=True)
    return replace(info, named=False)


class Sidecar:
    """Record of a run (`RunInfo`), kept in memory and in the file `run.json` with the same content.

    Args:
        folder: Folder of the run, which contains the file.
        info: The record.
    """

    def __init__(self, folder: Path, info: RunInfo) -> None:
        self.info = info
        self._path = folder / SIDECAR
        self._lock = threading.Lock()

    def update(self, **changes: Any) -> None:
        """Change fields of `info`, and write the file; if that fails, log a warning."""
        with self._lock:
            self.info = replace(self.info, **changes)
            stored = asdict(self.info)
            stored |= {"uri": without_password(stored["uri"])}
            del stored["named"]
            try:
                write_whole(self._path, json.dumps(stored, indent=1).encode())
            except (
                OSError
            ) as error:  # lines that an old file does not count are sent again, which the store ignores
                _log.warning("%s could not be written: %s.", self._path, error.strerror)
