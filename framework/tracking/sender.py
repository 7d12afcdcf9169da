"""Sending of a journal to a store, in batches, with retries for as long as needed."""

import logging
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from framework.errors import DataError, UserError
from framework.tracking.journal import Journal
from framework.tracking.run_info import RunInfo, Sidecar
from framework.tracking.stores import without_password

_log = logging.getLogger(__name__)

_BATCH = 1000  # metrics, parameters and tags that a store accepts in one call
_LINES = 50  # number of waiting lines that triggers a call of the store
_SECONDS = 2.0  # longest time that a line waits while the store answers
_PAUSE = 0.5  # shortest time between calls, so that a fast training is not slowed by its own numbers
# first and longest time between attempts, in seconds; it doubles each time
_FIRST_RETRY, _LAST_RETRY = 1.0, 30.0

Record = dict[str, Any]


class Store(ABC):
    """Contract of the connection to one run in a store.

    A method may raise any exception if the store fails; the sender then tries again later.
    """

    identity: Mapping[str, Any]
    """Names and new values of the fields of `RunInfo` that change when the store is opened, such as `run_id`."""
    replay: Mapping[str, Any]
    """Names and values of the fields `replay_after` and `replay_until` of `RunInfo` after the batches sent so far."""

    @abstractmethod
    def send(self, batch: Sequence[Record]) -> None:
        """Store one batch that `batches` yielded; a batch that is sent twice must be stored only once."""

    @abstractmethod
    def send_file(self, path: str, place: str) -> None:
        """Store a file or a directory under the folder `place`; `path` is absolute or relative to the run folder.

        Raises:
            DataError: Files may not be sent to this store; a further attempt would fail too.
        """


OpenStore = Callable[[Path, RunInfo], Store]
"""Type of a function that opens the run in its store, given the run folder and the content of `run.json`."""


def batches(records: Sequence[Record]) -> Iterator[list[Record]]:
    """Yield the records in order, grouped so that few calls of the store are needed.

    Metrics, parameters and tags share a batch. A file, a change of status, a data set or a resumption is a batch of its
    own.
    """
    batch: list[Record] = []
    size = 0
    for record in records:
        entries = sum(len(record.get(kind, ())) for kind in ("values", "params", "tags"))
        alone = not record.keys() & {"values", "params", "tags"}
        if batch and (alone or size + entries > _BATCH):
            yield batch
            batch, size = [], 0
        if alone:
            yield [record]
        else:
            batch.append(record)
            size += entries
    if batch:
        yield batch


def send_new(journal: Journal, sidecar: Sidecar, store: Store, stop: Callable[[], bool]) -> int:
    """Send the journal lines that the store lacks until `stop()` returns True, and return the number of lines sent.

    Lines that are written to the journal during this call are left for the next call. Otherwise each line of a training
    would be sent in a call of its own.

    Args:
        journal: Journal of the run.
        sidecar: Record of the run, which says how much of the journal was sent, and is updated.
        store: Run in the store.
        stop: Function that returns whether to stop before the next batch.
    """
    count, last_line = 0, journal.last
    while sidecar.info.sent < last_line and (records := journal.read(sidecar.info.sent)):
        for batch in batches(records):
            if stop():
                return count
            last = batch[-1]["n"]
            if "artifact" in batch[0]:
                # Files are listed here and sent later, so that a file that cannot be sent does not delay the numbers.
                owed = (*sidecar.info.owed, (batch[0]["artifact"], batch[0]["folder"]))
                sidecar.update(sent=last, owed=owed)
            else:
                store.send(batch)
                sidecar.update(sent=last, **store.replay)
            count += len(batch)
    return count


def send_owed(
    sidecar: Sidecar,
    store: Store,
    stop: Callable[[], bool],
    refused: Callable[[DataError], None] | None = None,
) -> None:
    """Send the files that must still be sent (`RunInfo.owed`), in order.

    Args:
        sidecar: Record of the run, which lists the files.
        store: Run in the store.
        stop: Function that returns whether to stop before the next file.
        refused: Function that is called with the error if a file may not be sent; the next file is then sent. None: the
            error is raised.
    """
    while sidecar.info.owed and not stop():
        try:
            store.send_file(*sidecar.info.owed[0])
        except DataError as error:
            if refused is None:
                raise
            refused(error)
        sidecar.update(owed=sidecar.info.owed[1:])


def send_all(folder: Path, journal: Journal, sidecar: Sidecar, open_store: OpenStore) -> int:
    """Send everything of a run whose process has ended, and return the number of journal lines sent.

    Args:
        folder: Folder of the run.
        journal: Journal of the run.
        sidecar: Record of the run, which says what was sent.
        open_store: Function that opens the run in its store.

    Raises:
        UserError: The store did not accept everything.
    """
    try:
        store = open_store(folder, sidecar.info)
        sidecar.update(**store.identity)
        count = send_new(journal, sidecar, store, lambda: False)
        send_owed(sidecar, store, lambda: False)
    except Exception as error:
        raise UserError(
            f"The tracking store {without_password(sidecar.info.uri)} did not accept everything ({reason(error)}). "
            f"{journal.path} contains the rest. Try again when the store can be reached."
        ) from error
    return count


class Sender(threading.Thread):
    """Thread that sends a growing journal until `finish` is called, and tries again after failures of the store.

    Args:
        folder: Folder of the run.
        journal: Journal to send.
        sidecar: Record of the run, which says how much of the journal was sent.
        open_store: Function that opens the run in its store.
    """

    def __init__(self, folder: Path, journal: Journal, sidecar: Sidecar, open_store: OpenStore) -> None:
        super().__init__(name="tracking", daemon=True)  # a store that hangs does not keep the process alive
        self.tried = threading.Event()
        """Event that is set once the store has answered or failed for the first time."""
        self._folder = folder
        self._journal = journal
        self._sidecar = sidecar
        self._open_store = open_store
        self._store: Store | None = None
        self._waiting_lines = 0
        self._wake = threading.Event()
        self._finishing = threading.Event()
        self._abandoned = False
        self._away_since: float | None = None
        self._refusal_logged = False

    def notice(self) -> None:
        """Count one more line that waits to be sent, and start sending if many lines wait."""
        self._waiting_lines += 1
        if self._waiting_lines >= _LINES:
            self._wake.set()

    def warn(self, why: str) -> None:
        """Log a warning that the store cannot be reached, unless the warning was logged before."""
        if self._away_since is None:
            self._away_since = time.monotonic()
            _log.warning(
                "The tracking store %s cannot be reached or written (%s). The run continues; %s contains everything, "
                "which is sent when the store can be reached again.",
                without_password(self._sidecar.info.uri),
                why,
                self._journal.path,
            )

    def finish(self, patience: float) -> bool:
        """Send the remaining lines and files, stop, and return whether all were sent within `patience` seconds."""
        self._finishing.set()
        self._wake.set()
        self.join(patience)
        self._abandoned = True
        info = self._sidecar.info
        return not self.is_alive() and info.sent >= self._journal.last and not info.owed

    def run(self) -> None:
        retry = _FIRST_RETRY
        while not self._abandoned:
            finishing = self._finishing.is_set()
            self._waiting_lines = 0
            self._wake.clear()
            try:
                self._send()
            except Exception as error:
                self._store = None  # the store is opened again, because it may have been replaced
                self.warn(reason(error))
                self.tried.set()
                # After `finish`, little time is left, so the next attempt follows soon.
                if finishing:
                    time.sleep(_FIRST_RETRY)
                else:
                    self._finishing.wait(retry)
                retry = min(2 * retry, _LAST_RETRY)
                continue
            retry = _FIRST_RETRY
            self.tried.set()
            if self._away_since is not None:
                seconds, self._away_since = time.monotonic() - self._away_since, None
                uri = without_password(self._sidecar.info.uri)
                _log.warning(
                    "The tracking store %s can be reached again after %.0f s and has received everything.",
                    uri,
                    seconds,
                )
            if finishing:
                return
            if not self._finishing.wait(_PAUSE):
                self._wake.wait(_SECONDS - _PAUSE)

    def _send(self) -> None:
        if self._store is None:
            self._store = self._open_store(self._folder, self._sidecar.info)
            self._sidecar.update(**self._store.identity)
        send_new(self._journal, self._sidecar, self._store, lambda: self._abandoned)
        send_owed(self._sidecar, self._store, lambda: self._abandoned, self._log_refusal)

    def _log_refusal(self, error: DataError) -> None:
        if not self._refusal_logged:
            self._refusal_logged = True
            _log.warning("The store receives the numbers of this run, but not its files: %s", error)


def reason(error: BaseException) -> str:
    """Return the message of the root cause of a store's exception as one line, without passwords."""
    while (cause := error.__cause__ or error.__context__) is not None:
        error = cause  # "Connection refused" and "database is locked" are at the end of the chain
    line = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
    return without_password(line if len(line) <= 200 else line[:199] + "…").rstrip(". ")
