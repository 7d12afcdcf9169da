"""What is known of a run beside its numbers: where it is stored, how far, how it ended. Kept in run.json."""

import json
import logging
import os
import re
import threading
import time
import uuid
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from pydantic import TypeAdapter

from framework.errors import ConfigError
from framework.storage.files import write_whole
from framework.storage.reading import guarded, read_bytes

_log = logging.getLogger(__name__)

SIDECAR = "run.json"
MODEL = "model:"
"""The place of a checkpoint that the store keeps as the run's model, and not in a folder of its files."""
_SQLITE = "sqlite:///"


@dataclass(frozen=True)
class Destination:
    """A run in a store.

    Attributes:
        uri: an MLflow tracking URI; None: `default_uri` of the run's folder.
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
    """The store; empty where only the journal is kept."""
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

    @classmethod
    def at(cls, place: Destination, folder: Path) -> "RunInfo":
        """Of a run in `folder` that begins now.

        Raises:
            ConfigError: MLflow cannot keep runs in that store.
        """
        uri = store_uri(place.uri) if place.uri else default_uri(folder)
        files, key = artifact_folder(uri, folder), uuid.uuid4().hex
        return cls(
            place.run_id,
            uri,
            place.experiment,
            place.run_name,
            place.parent,
            files,
            key,
            time.time(),
            "RUNNING",
        )


def read_run_info(folder: Path) -> RunInfo | None:
    """What `run.json` in a run folder says; None where there is none.

    Raises:
        DataError: it is not what a tracker wrote.
    """
    path = folder / SIDECAR
    if not path.exists():
        return None
    with guarded(path, "what a tracker wrote", "Remove it, and the run begins anew."):
        return TypeAdapter(RunInfo).validate_json(read_bytes(path))


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
            try:
                write_whole(self._path, json.dumps(asdict(self.info), indent=1).encode())
            except (
                OSError
            ) as error:  # an old one costs only that lines are sent again, which the store ignores
                _log.warning("%s could not be written: %s.", self._path, error.strerror)


def require_own_store(uri: str, given: str | None, source: Path) -> None:
    """Refuse to send to a server that only a file names: a run folder may be a stranger's.

    Args:
        given: the store that the user names.

    Raises:
        ConfigError: it is neither a local file, nor on this machine, nor named by `given` or MLFLOW_TRACKING_URI.
    """
    own = [without_password(name) for name in (given, os.environ.get("MLFLOW_TRACKING_URI")) if name]
    here = not uri or uri.startswith(_SQLITE) or urlsplit(uri).hostname in ("localhost", "127.0.0.1", "::1")
    if not here and without_password(uri) not in own:
        raise ConfigError(
            f"{source} says that the run goes to {without_password(uri)}. If that is where you keep runs, say so: add "
            f"logger.uri={without_password(uri)}"
        )


def default_uri(folder: Path) -> str:
    """The SQLite store for a run folder: mlflow.db in the `outputs` folder around it, else beside it."""
    return f"{_SQLITE}{_outputs(folder) / 'mlflow.db'}"


def store_uri(uri: str) -> str:
    """A tracking URI that means the same from every working directory.

    Raises:
        ConfigError: MLflow keeps no runs there.
    """
    if uri.startswith(_SQLITE):
        path, question, query = uri.removeprefix(_SQLITE).partition("?")
        if path in ("", ":memory:"):
            raise ConfigError(f"logger.uri={uri} keeps nothing. Give a file: sqlite:///outputs/mlflow.db.")
        return f"{_SQLITE}{Path(path).expanduser().absolute()}{question}{query}"
    if not re.match(r"(https?|(postgresql|mysql|mssql)(\+\w+)?)://.|databricks", uri):
        raise ConfigError(
            f"logger.uri={uri}: wanted sqlite:///<file>, the http(s)://<host>:<port> of a server, or a "
            "postgresql, mysql or mssql address. MLflow no longer keeps runs in plain folders."
        )
    return uri


def sqlite_path(uri: str) -> Path | None:
    """The file of an SQLite store; None for any other."""
    return Path(uri.removeprefix(_SQLITE).partition("?")[0]) if uri.startswith(_SQLITE) else None


def artifact_folder(uri: str, folder: Path) -> str | None:
    """Where a new experiment keeps its files; None for servers, which know themselves.

    Absolute, since MLflow's own default hangs on the working directory.
    """
    path = sqlite_path(uri)
    if path is not None:
        return str(path.parent / "artifacts")
    return None if uri.startswith(("http", "databricks")) else str(_outputs(folder) / "artifacts")


def without_password(uri: str) -> str:
    """A text with tracking URIs that can be shown."""
    return re.sub(r"//[^/@\s]*@", "//", uri)


def _outputs(folder: Path) -> Path:
    parents = folder.absolute().parents
    return next((parent for parent in parents if parent.name == "outputs"), parents[0])
