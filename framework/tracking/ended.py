"""Closing of a run whose process has ended, and sending of the missing part of its journal to the store."""

import logging
from pathlib import Path

from framework.errors import DataError, UserError
from framework.storage.enclosed import require_enclosed
from framework.tracking.journal import Journal
from framework.tracking.run_info import SIDECAR, Sidecar, read_run_info
from framework.tracking.sender import send_all
from framework.tracking.stores import confirm_address
from framework.tracking.tracker import JOURNAL, Status, mlflow_store

_log = logging.getLogger(__name__)


def sync(folder: Path, uri: str | None = None) -> int:
    """Send the journal lines that the store lacks, for a run whose process has ended, and return their number.

    Args:
        folder: Folder of the run; it may come from an untrusted source.
        uri: Address of the store that the user names (`stores.confirm_address`).

    Raises:
        ConfigError: The user does not name the store of the run.
        DataError: The folder contains no run with a store, or contains links, or the run's process is alive.
        UserError: The store did not accept everything; lines that it accepted are not sent again.
    """
    folder = folder.absolute()
    require_enclosed(folder)
    info = read_run_info(folder)
    if info is None or not info.uri:
        raise DataError(
            f"{folder} contains no run that is sent to a store: {SIDECAR} is missing, or the run has logger=none. "
            "Give the folder of a run with a store."
        )
    info = info.at_store(confirm_address(info.uri, uri, folder, folder / SIDECAR), folder)
    journal = Journal(folder / JOURNAL)
    journal.open(after=info.sent)  # this prevents other processes from sending
    try:
        return send_all(folder, journal, Sidecar(folder, info), mlflow_store())
    finally:
        journal.close()


def mark_dead(folder: Path, status: Status = "KILLED", uri: str | None = None, *, send: bool = True) -> bool:
    """Close a run whose process died without closing it, and return whether there was a run to close.

    The function also sends the lines that the store lacks. If the store cannot be reached, or if the user does not name
    the store, the journal and `run.json` record the status, and a later `sync` sends it.

    Args:
        folder: Folder of the run; it may come from an untrusted source.
        status: Status to record.
        uri: Address of the store that the user names (`stores.confirm_address`).
        send: Whether to contact the store.

    Raises:
        DataError: The process is alive, or the folder contains links.
    """
    folder = folder.absolute()
    require_enclosed(folder)
    info = read_run_info(folder)
    if info is None or info.status != "RUNNING":
        return False
    journal = Journal(folder / JOURNAL)
    journal.open(after=info.sent)
    info = read_run_info(folder) or info
    if info.status != "RUNNING":  # another process was faster
        journal.close()
        return False
    sidecar = Sidecar(folder, info)
    journal.append(status=status)
    sidecar.update(status=status)
    try:
        if info.uri and send:
            store = confirm_address(info.uri, uri, folder, folder / SIDECAR)
            sidecar = Sidecar(folder, sidecar.info.at_store(store, folder))
            send_all(folder, journal, sidecar, mlflow_store())
    except UserError as error:
        _log.warning("%s", error)
    finally:
        journal.close()
    return True


def close_and_send(folder: Path, uri: str | None = None) -> None:
    """Close a run as `mark_dead` does, or send the lines that the store lacks if the run is already closed.

    A run that the watcher (`framework.tracking.watch`) has closed is closed in its folder only, so its store lacks the
    status.

    Args:
        folder: Folder of the run; it may come from an untrusted source.
        uri: Address of the store that the user names (`stores.confirm_address`).

    Raises:
        DataError: The process is alive, or the folder contains links.
    """
    info = read_run_info(folder)
    if mark_dead(folder, uri=uri) or info is None or not info.uri:
        return
    try:
        sync(folder, uri)
    except UserError as error:
        _log.warning("%s", error)
