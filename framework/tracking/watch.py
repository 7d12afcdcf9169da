"""A small process beside a run, which closes the run where its own process is killed and cannot do so itself.

Its arguments are the run folder, the process of the run, and the parent with which that one is to end (a sweep, for
one of its jobs), or 0. It ends with the run.
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
"""Seconds between two looks at the process."""


@contextmanager
def watched(folder: Path) -> Iterator[None]:
    """Inside the block, a process of its own watches this one, whose run is in `folder`.

    If this process dies, the run is closed as KILLED, in the folder alone: a later `sync` tells the store. If this
    process is one that ends with its parent, and that dies, it has `ENDING` seconds to close the run; then it is
    killed, with all processes of its group.
    """
    parent = os.getppid() if ends_with_parent() else 0
    watcher = subprocess.Popen(
        [*_COMMAND, str(folder.absolute()), str(os.getpid()), str(parent)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # what is sent to the group of the run is not for the watcher
    )
    try:
        yield
    finally:
        watcher.kill()  # the run is closed
        watcher.wait()


def watch(folder: Path, run: int, parent: int) -> None:
    """Wait until the process of a run ends; close the run where it has not."""
    orphaned_at: float | None = None
    while os.getppid() == run:
        if parent and orphaned_at is None and _parent_of(run) not in (parent, None):
            orphaned_at = time.monotonic()
        if orphaned_at is not None and time.monotonic() - orphaned_at > ENDING:
            _kill(run)
        time.sleep(_PAUSE)

    from framework.errors import DataError  # imported for this alone
    from framework.tracking.ended import mark_dead

    with suppress(DataError):  # another process goes on with the run
        mark_dead(folder, send=False)


def _parent_of(process: int) -> int | None:
    """The process that waits for another one; None where that cannot be known."""
    try:
        state = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    return int(state.rpartition(")")[2].split()[1])


def _kill(run: int) -> None:
    """Kill the process, with its group where it leads one; the watcher is its child, so no other has its number."""
    with suppress(ProcessLookupError):
        if os.getpgid(run) == run:
            os.killpg(run, signal.SIGKILL)
        else:
            os.kill(run, signal.SIGKILL)


if __name__ == "__main__":
    watch(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
