"""What is known of a run beside its numbers: where it is stored, how far, how it ended. Kept in run.json."""

import json
import logging
import os
import threading
import time
import uuid
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from framework.storage.enclosed import read_plain
from framework.storage.files import write_whole
from framework.storage.plain_values import LARGEST_JSON
from framework.storage.reading import guarded
from framework.tracking.stores import Address, address, artifact_folder, require_own_files, without_password

_log = logging.getLogger(__name__)

SIDECAR = "run.json"
MODEL = "model:"
"""The place of a checkpoint that the store keeps as the run's model, and not in a folder of its files."""


@dataclass(frozen=True)
class Destination:
    """A run in a store.

    Attributes:
        uri: an MLflow tracking URI that the user names; None: see `stores.address`.
        experiment: its name in MLflow; made if new.
        run_name: shown in MLflow.
        parent: run id under which MLflow shows this one.
        run_id: of the run to go on with; None: a new run, or the one in the folder if that has no id yet.
    """

    uri: str | None
    experiment: str
    run_name: str
    parent: str | None = None
    run_id: str | None = None


@dataclass(frozen=True)
class RunInfo:
    """What `run.json` in the run folder holds: enough to go on with the run from another process."""

    run_id: str | None
    """The store's id; None while the store has not been reached."""
    uri: str
    """The store, in the file without a password; empty where only the journal is kept."""
    experiment: str
    run_name: str
    parent: str | None
    """The store's id of the run this one belongs to, such as a sweep."""
    artifacts: str | None
    """Where a new experiment keeps its files; None: the store decides."""
    key: str
    """Our own id, by which a run whose creation was cut short is found again in the store."""
    started: float
    """Seconds since 1970."""
    status: str
    """RUNNING, FINISHED, FAILED or KILLED."""
    experiment_id: str | None = None
    sent: int = 0
    """Lines of the journal up to this number are in the store."""
    replay_after: int | None = None
    """The step the run was last resumed from, and repeats what came after."""
    replay_until: dict[str, int] = field(default_factory=dict)
    """Up to which step each metric was in the store by then, and need not be sent again."""
    owed: tuple[tuple[str, str], ...] = ()
    """Files (path, folder in the store) that the store has still to take."""
    named: bool = False
    """Whether the user named the store (`stores.Address`); never read from a file."""

    @classmethod
    def at(cls, place: Destination, folder: Path) -> "RunInfo":
        """Of a run in `folder` that begins now.

        Raises:
            ConfigError: MLflow cannot keep runs in that store.
            DataError: the default store leads out of its folder.
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
        """Return the same run, to be sent to the user's own address of its store."""
        return replace(self, uri=store.uri, named=store.named, artifacts=artifact_folder(store.uri, folder))


def read_run_info(folder: Path) -> RunInfo | None:
    """What `run.json` in a run folder says; None where there is none.

    Raises:
        DataError: it is not what a tracker wrote.
    """
    path = folder / SIDECAR
    if not os.path.lexists(path):
        return None
    with guarded(path, "what a tracker wrote", "Remove it, and the run begins anew."):
        found = TypeAdapter(RunInfo).validate_json(read_plain(path, LARGEST_JSON), strict=True)
    return replace(found, named=False)


class Sidecar:
    """`run.json`, in memory and on disk."""

    def __init__(self, folder: Path, info: RunInfo) -> None:
        self.info = info
        self._path = folder / SIDECAR
        self._lock = threading.Lock()

    def update(self, **changes: Any) -> None:
        """Change fields of `info`; on disk when this returns, if the disk has room."""
        with self._lock:
            self.info = replace(self.info, **changes)
            stored = asdict(self.info)
            stored |= {"uri": without_password(stored["uri"])}
            del stored["named"]
            try:
                write_whole(self._path, json.dumps(stored, indent=1).encode())
            except (
                OSError
            ) as error:  # an old one costs only that lines are sent again, which the store ignores
                _log.warning("%s could not be written: %s.", self._path, error.strerror)
