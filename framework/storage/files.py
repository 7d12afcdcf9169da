"""Files that are whole or absent, and locks between processes."""

import errno
import fcntl
import logging
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from traceback import walk_tb

from filelock import FileLock

_log = logging.getLogger(__name__)
_THREADS = threading.RLock()
_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP)
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_CLOSED = (
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.ENOTDIR,
    errno.EEXIST,
    errno.EISDIR,
    errno.ENAMETOOLONG,
)


def full(error: OSError) -> bool:
    """Whether a disk has no more room, or its user may use no more."""
    return error.errno in _FULL


def unwritable(error: BaseException) -> str | None:
    """What is wrong with a place that takes nothing, and what to do, as a sentence; None for any other error."""
    if not isinstance(error, OSError) or not (error.errno in (*_FULL, *_CLOSED) or _unmade(error)):
        return None
    where = f"{error.filename} cannot be written" if error.filename else "A file cannot be written"
    remedy = "Free some space" if full(error) else "Choose another place"
    return f"{where} ({error.strerror}). {remedy}."


def _unmade(error: OSError) -> bool:
    """Return whether a folder could not be made; /proc, say, then says that there is no such file."""
    frames = [frame.f_code.co_name for frame, _ in walk_tb(error.__traceback__)]
    return error.errno == errno.ENOENT and frames[-1:] == ["mkdir"]


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file beside `path` to write; it takes that name, its bytes synced, when the block ends without an error.

    A crash, SIGKILL or power cut leaves the old file or the new one; an error leaves the old one. Its folder is made.

    Raises:
        OSError: there is no room, or no right to write.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(
        f".{path.name}.{socket.gethostname()}.{threading.get_ident()}.{os.getpid()}.partial"
    )
    try:
        yield partial
        sync(partial)
        partial.replace(path)
        sync(path.parent)
    finally:
        partial.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes) -> None:
    """Replace a file by `content`, on the disk when this returns; see `replacing`."""
    with replacing(path) as partial:
        partial.write_bytes(content)


def remove_leftovers(folder: Path) -> None:
    """Delete what processes of this machine that are no more began to write in `folder`."""
    for partial in folder.glob(f".*.{socket.gethostname()}.*.partial"):
        try:
            os.kill(int(partial.suffixes[-2][1:]), 0)
        except ProcessLookupError:
            partial.unlink(missing_ok=True)
        except (PermissionError, ValueError):
            continue  # the process lives, under another user; or the name is none of ours


def sync(path: Path) -> None:
    """Ask the disk for a file's bytes, or for the names in a folder."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def lock_within(descriptor: int, seconds: float) -> None:
    """Take the POSIX record lock of a file, which is this process's alone until it closes any descriptor of the file.

    Raises:
        BlockingIOError, PermissionError: after so many seconds another process still holds it.
        OSError: the file system has no locks.
    """
    deadline = time.monotonic() + seconds
    while True:
        try:
            return fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            if time.monotonic() > deadline:
                raise
        time.sleep(0.02)


@contextmanager
def alone(path: Path) -> Iterator[None]:
    """Hold the lock `path`; waits for other processes and threads. It ends with the process, whatever ends that.

    A file system without `flock` (Lustre and NFS as some mount them) gets a POSIX record lock, and one without either
    a warning.
    """
    lock = FileLock(path, thread_local=False)
    try:
        lock.acquire()
    except (NotImplementedError, OSError) as error:
        if not unlockable(error):
            raise
        with _alone_by_record(path):
            yield
        return
    try:
        yield
    finally:
        lock.release()


def unlockable(error: BaseException) -> bool:
    """Return whether a file system has no such locks."""
    return isinstance(error, NotImplementedError) or (isinstance(error, OSError) and error.errno in _NO_LOCKS)


@contextmanager
def _alone_by_record(path: Path) -> Iterator[None]:
    with _THREADS:  # a record lock is the whole process's
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            try:
                fcntl.lockf(descriptor, fcntl.LOCK_EX)
            except OSError as error:
                if not unlockable(error):
                    raise
                warn_unlocked(path, error)
            yield
        finally:
            os.close(descriptor)


def warn_unlocked(path: Path, error: BaseException) -> None:
    """Say that nothing keeps other processes away."""
    why = error.strerror if isinstance(error, OSError) else error
    _log.warning("%s: no locks on this file system (%s); let one command at a time use it.", path.parent, why)
