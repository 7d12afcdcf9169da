"""Atomic writing of files, which are complete or absent afterwards, and locks between processes."""

import errno
import fcntl
import logging
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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


def remove_empty_folders(folder: Path) -> None:
    """Remove the folder of a command that wrote nothing, and folders above it in `outputs` that hold nothing else.

    Folders that hold files stay.
    """
    outputs = Path("outputs").absolute()
    with suppress(OSError):
        folder.rmdir()
        for parent in folder.absolute().parents:
            if not parent.is_relative_to(outputs):
                break
            parent.rmdir()


def is_disk_full(error: OSError) -> bool:
    """Return whether an error says that the disk is full or the user's quota is used up."""
    return error.errno in _FULL


def describe_unwritable(error: BaseException) -> str | None:
    """Return a sentence that says which file cannot be written, why, and what to do; None for any other error."""
    if not isinstance(error, OSError) or not (error.errno in (*_FULL, *_CLOSED) or _is_missing_parent(error)):
        return None
    where = f"{error.filename} cannot be written" if error.filename else "A file cannot be written"
    remedy = "Free some space" if is_disk_full(error) else "Choose another path"
    return f"{where} ({error.strerror}). {remedy}."


def _is_missing_parent(error: OSError) -> bool:
    """Return whether creating a folder failed with "no such file", as it does in /proc, which allows no new folders."""
    frames = [frame.f_code.co_name for frame, _ in walk_tb(error.__traceback__)]
    return error.errno == errno.ENOENT and frames[-1:] == ["mkdir"]


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, and rename the file there to `path` if the block ends without an error.

    The file is synced to the disk before it is renamed. So a crash, SIGKILL or power cut leaves either the complete old
    file or the complete new one, and an error leaves the old one. The folder of `path` is created if it is missing.

    Raises:
        OSError: The disk is full, or there is no permission to write.
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
    """Replace a file by `content` atomically, as `replacing` does; the bytes are on disk when this returns."""
    with replacing(path) as partial:
        partial.write_bytes(content)


def remove_leftovers(folder: Path) -> None:
    """Delete temporary files in `folder` that `replacing` left because its process, on this machine, was killed."""
    for partial in folder.glob(f".*.{socket.gethostname()}.*.partial"):
        try:
            os.kill(int(partial.suffixes[-2][1:]), 0)
        except ProcessLookupError:
            partial.unlink(missing_ok=True)
        except (PermissionError, ValueError):
            continue  # the process still runs under another user, or `replacing` did not create the file


def sync(path: Path) -> None:
    """Force a file's bytes, or the names in a folder, onto the disk (fsync)."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def try_lock(path: Path) -> tuple[int, OSError | None] | None:
    """Lock the file `path` without waiting.

    On a file system without `flock`, a POSIX record lock is used, which ends with this process and which other
    processes do not inherit.

    Returns:
        None if another process holds the lock, otherwise a pair. Its first element is the descriptor of the lock. Its
        second element is None or, if the file system has no locks at all, the error of the file system.
    """
    descriptor, missing = os.open(path, os.O_RDWR | os.O_CREAT, 0o644), None
    for lock in (fcntl.flock, fcntl.lockf):
        try:
            lock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            os.close(descriptor)
            return None
        except OSError as error:
            if not lacks_locks(error):
                os.close(descriptor)
                raise
            missing = error
        else:
            return descriptor, None
    return descriptor, missing


def lock_within(descriptor: int, seconds: float) -> None:
    """Acquire the POSIX record lock of a file, which this process holds until it closes any descriptor of the file.

    Raises:
        BlockingIOError, PermissionError: Another process still holds the lock after `seconds`.
        OSError: The file system has no locks.
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
def hold_lock(path: Path) -> Iterator[None]:
    """Hold the lock file `path` during the block, after waiting for other processes and threads.

    The lock is released when the process ends, even if it is killed. On a file system without `flock` (some mounts of
    Lustre and NFS), a POSIX record lock is used; on a file system without either lock, a warning is logged.
    """
    lock = FileLock(path, thread_local=False)
    try:
        lock.acquire()
    except (NotImplementedError, OSError) as error:
        if not lacks_locks(error):
            raise
        with _hold_record_lock(path):
            yield
        return
    try:
        yield
    finally:
        lock.release()


def lacks_locks(error: BaseException) -> bool:
    """Return whether an error says that the file system does not support locks."""
    return isinstance(error, NotImplementedError) or (isinstance(error, OSError) and error.errno in _NO_LOCKS)


@contextmanager
def _hold_record_lock(path: Path) -> Iterator[None]:
    with _THREADS:  # a record lock belongs to the whole process, so threads need a lock of their own
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            try:
                fcntl.lockf(descriptor, fcntl.LOCK_EX)
            except OSError as error:
                if not lacks_locks(error):
                    raise
                warn_unlocked(path, error)
            yield
        finally:
            os.close(descriptor)


def warn_unlocked(path: Path, error: BaseException) -> None:
    """Log a warning that no lock keeps other processes away from the folder of `path`."""
    why = error.strerror if isinstance(error, OSError) else error
    _log.warning(
        "The file system of %s does not support locks (%s). Run only one command at a time in this folder.",
        path.parent,
        why,
    )
