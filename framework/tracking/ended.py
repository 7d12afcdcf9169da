"""What others do for a run whose process has ended: close it, and send what its store lacks."""

import logging
from pathlib import Path

from framework.errors import DataError, UserError
from framework.storage.enclosed import require_enclosed
from framework.tracking.journal import Journal
from framework.tracking.run_info import SIDECAR, Sidecar, read_run_info
from framework.tracking.sender import send_all
from framework.tracking.stores import confirmed
from framework.tracking.tracker import JOURNAL, Status, mlflow_store

_log = logging.getLogger(__name__)


def sync(folder: Path, uri: str | None = None) -> int:
    """Send what the store lacks of a run whose process has ended; return how many lines of its journal that were.

    Args:
        folder: of the run; it may be a stranger's.
        uri: the store that the user names (`stores.confirmed`).

    Raises:
        ConfigError: the user names no such store as the run's.
        DataError: no run with a store is there, its process is alive, or the folder holds links.
        UserError: the store did not take everything; what it took is not sent again.
    """
    folder = folder.absolute()
    require_enclosed(folder)
    info = read_run_info(folder)
    if info is None or not info.uri:
        raise DataError(f"{folder} holds no run that goes to a store: it has no {SIDECAR}, or logger=none.")
    info = info.at_store(confirmed(info.uri, uri, folder, folder / SIDECAR), folder)
    journal = Journal(folder / JOURNAL)
    journal.open(after=info.sent)  # and so nobody else sends
    try:
        return send_all(folder, journal, Sidecar(folder, info), mlflow_store())
    finally:
        journal.close()


def mark_dead(folder: Path, status: Status = "KILLED", uri: str | None = None, *, send: bool = True) -> bool:
    """Close a run whose process died without closing it; False where there is nothing to close.

    Sends what the store lacks, too. Where the store is away, or is none that the user names, the journal and `run.json`
    hold the status, and a later `sync` tells the store.

    Args:
        folder, uri: as of `sync`.
        send: whether to tell the store; without, this does not wait for anything.

    Raises:
        DataError: the process is alive, or the folder holds links.
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
            store = confirmed(info.uri, uri, folder, folder / SIDECAR)
            sidecar = Sidecar(folder, sidecar.info.at_store(store, folder))
            send_all(folder, journal, sidecar, mlflow_store())
    except UserError as error:
        _log.warning("%s", error)
    finally:
        journal.close()
    return True


def close_and_send(folder: Path, uri: str | None = None) -> None:
    """As `mark_dead`; where the run was closed in its folder alone (`watch`), tell the store.

    Raises:
        DataError: as of `mark_dead`.
    """
    info = read_run_info(folder)
    if mark_dead(folder, uri=uri) or info is None or not info.uri:
        return
    try:
        sync(folder, uri)
    except UserError as error:
        _log.warning("%s", error)
