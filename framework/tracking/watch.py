"""Small process that closes a run after the run's own process was killed.

The program has three arguments: the run folder, the id of the run's process, and the id of the process with which the
run must end. For a job, that is the process of its sweep; it is 0 if there is no such process. The program ends with
the run.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from framework.tracking.signals import ENDING, ends_with_parent

_COMMAND = (sys.executable, "-P", "-m", __name__)
_PAUSE = 0.25
"""Seconds between two checks of the process."""


@contextmanager
def start_watcher(folder: Path) -> Iterator[None]:
    """Start a process that watches this process, whose run is in `folder`, during the block.

    If this process dies, the watcher records the status KILLED in the folder; a later `sync` sends the status to the
    store. If this process must end with its parent (`signals.end_with_parent`), it has `ENDING` seconds after the death
    of the parent to close the run. After that, the watcher kills it together with all processes of its group.
    """
    parent = os.getppid() if ends_with_parent() else 0
    watcher = subprocess.Popen(
        [*_COMMAND, str(folder.absolute()), str(os.getpid()), str(parent)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # so that signals to the process group of the run do not reach the watcher
    )
    try:
        yield
    finally:
        watcher.kill()  # the run is closed
        watcher.wait()


def watch(folder: Path, run: int, parent: int) -> None:
    """Wait until the process of a run ends, and close the run if that process has not closed it.

    Args:
        folder: Folder of the run.
        run: Id of the run's process, which is the parent of this process.
        parent: Id of the process with which the run must end; 0 for none.
    """
    orphaned_at: float | None = None
    while os.getppid() == run:
        if parent and orphaned_at is None and _parent_of(run) not in (parent, None):
            orphaned_at = time.monotonic()
        if orphaned_at is not None and time.monotonic() - orphaned_at > ENDING:
            _kill(run)
        time.sleep(_PAUSE)

    from framework.errors import DataError  # imported only when it is needed
    from framework.tracking.ended import mark_dead

    with suppress(DataError):  # another process continues the run
        mark_dead(folder, send=False)


def _parent_of(process: int) -> int | None:
    """Return the id of a process's parent; None if the system does not provide it."""
    try:
        state = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    return int(state.rpartition(")")[2].split()[1])


def _kill(run: int) -> None:
    """Kill the process `run` and, if it leads a process group, all processes of this group.

    The watcher is a child of that process, so no other process can have the same id.
    """
    with suppress(ProcessLookupError):
        if os.getpgid(run) == run:
            os.killpg(run, signal.SIGKILL)
        else:
            os.kill(run, signal.SIGKILL)


if __name__ == "__main__":
    watch(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
