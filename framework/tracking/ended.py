"""What others do for a run whose process has ended: close it, and send what its store lacks."""

import logging
from dataclasses import replace
from pathlib import Path

from framework.errors import DataError, UserError
from framework.tracking.journal import Journal
from framework.tracking.run_info import SIDECAR, Sidecar, artifact_folder, read_run_info
from framework.tracking.sender import send_all
from framework.tracking.tracker import JOURNAL, Status, mlflow_store

_log = logging.getLogger(__name__)


def sync(folder: Path) -> int:
    """Send what the store lacks of a run whose process has ended; how many lines of its journal that were.

    Raises:
        DataError: no run with a store is there, or its process is alive.
        UserError: the store did not take everything; what it took is not sent again.
    """
    folder = folder.absolute()
    info = read_run_info(folder)
    if info is None or not info.uri:
        raise DataError(f"{folder} holds no run that goes to a store: it has no {SIDECAR}, or logger=none.")
    info = replace(
        info, artifacts=artifact_folder(info.uri, folder)
    )  # where files go is not for a file to say
    journal = Journal(folder / JOURNAL)
    journal.open(after=info.sent)  # and so nobody else sends
    try:
        return send_all(folder, journal, Sidecar(folder, info), mlflow_store())
    finally:
        journal.close()


def mark_dead(folder: Path, status: Status = "KILLED") -> bool:
    """Close a run whose process died without closing it; False where there is nothing to close.

    Sends what the store lacks, too. Where the store is away, the journal and `run.json` hold the status, and
    a later `sync` tells the store.

    Raises:
        DataError: the process is alive.
    """
    folder = folder.absolute()
    info = read_run_info(folder)
    if info is None or info.status != "RUNNING":
        return False
    journal = Journal(folder / JOURNAL)
    journal.open(after=info.sent)
    sidecar = Sidecar(folder, info)
    journal.append(status=status)
    sidecar.update(status=status)
    try:
        if info.uri:
            send_all(folder, journal, sidecar, mlflow_store())
    except UserError as error:
        _log.warning("%s", error)
    finally:
        journal.close()
    return True
