"""Sending of the journals of a sweep's jobs to the tracking store, while other jobs run."""

import logging
import os
import shlex
import threading
import time
from collections import deque
from pathlib import Path
from typing import Self

from framework.errors import ConfigError, DataError, UserError
from framework.tracking.signals import Stopped, collected_signals

PATIENCE = 60.0
"""Seconds for which a sweep whose jobs have ended tries to reach its store, counted from the last success."""
_FIRST_RETRY, _LAST_RETRY = 1.0, 30.0
"""Shortest and longest time between two attempts, in seconds; it doubles each time while jobs run."""

log = logging.getLogger(__name__)


class JournalSender:
    """Object that sends, in a thread, what ended jobs have not sent to the store themselves.

    If the store does not accept the journal of a job, the thread tries again. After the end of the `with` block of this
    object, the thread gives up when the store has accepted nothing for `PATIENCE` seconds. A warning then names the
    command that sends the rest.

    Args:
        store: Address of the tracking store that the command names.

    Raises:
        Stopped: At the end of the `with` block, if a signal was received while the thread was trying again.
    """

    def __init__(self, store: str | None) -> None:
        self._store = store
        self._patient = True
        self._received: list[int] = []  # signals
        self._folders = deque[Path]()
        self._thread: threading.Thread | None = None
        self._wake, self._finishing = threading.Event(), threading.Event()
        self._error: UserError | None = None  # of the last attempt

    def __enter__(self) -> Self:
        return self

    def add(self, folder: Path) -> None:
        """Send what the store lacks of the job in `folder`, after the jobs that were added before."""
        self._folders.append(folder)
        self._wake.set()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="journals", daemon=True)
            self._thread.start()

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        self._patient = kind is None
        with collected_signals() as self._received:
            self._finishing.set()
            self._wake.set()
            if self._thread is not None:
                self._thread.join()
        if self._folders:
            common = os.path.commonpath(self._folders)
            log.warning(
                f"Jobs that are incomplete in the tracking store: {len(self._folders)}. {self._error} The command for "
                f"all of them: `python -m framework mode=sync mode.run={shlex.quote(common)}`."
            )
        if self._received and self._patient:
            raise Stopped(self._received[0])

    def _run(self) -> None:
        retry, since = _FIRST_RETRY, time.monotonic()
        while True:
            self._wake.clear()
            if not self._folders:
                if self._finishing.is_set():
                    return
                self._wake.wait()
                since = time.monotonic()
            elif self._send(self._folders[0]):
                self._folders.popleft()
                retry, since = _FIRST_RETRY, time.monotonic()
            else:
                self._folders.rotate(-1)  # the store may refuse this job only
                if not self._finishing.wait(retry):
                    retry, since = min(2 * retry, _LAST_RETRY), time.monotonic()
                elif self._gives_up(since):
                    return

    def _gives_up(self, since: float) -> bool:
        """Wait before a further attempt; return True if there shall be none."""
        if not self._patient or self._received or time.monotonic() - since > PATIENCE:
            return True
        time.sleep(_FIRST_RETRY)
        return False

    def _send(self, folder: Path) -> bool:
        """Send the journal of a job; return False if a further attempt may succeed."""
        from framework.tracking.ended import sync  # imported late: Hydra imports this module at every start

        try:
            if not _is_sent(folder):
                sync(folder, self._store)
        except (ConfigError, DataError) as error:
            log.warning(f"{folder}: {error}")
        except UserError as error:
            if self._error is None:
                log.warning(f"{folder}: {error} The sweep tries again.")
            self._error = error
            return False
        return True


def _is_sent(folder: Path) -> bool:
    """Return whether the store has everything of a job, according to the files in the job's folder."""
    from framework.tracking.journal import Journal
    from framework.tracking.run_info import read_run_info
    from framework.tracking.tracker import JOURNAL

    info = read_run_info(folder)
    return info is None or not info.uri or not (info.owed or Journal(folder / JOURNAL).read(info.sent))
