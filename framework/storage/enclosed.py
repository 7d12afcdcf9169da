"""Safe access to run folders from untrusted sources: only plain files inside the folder are opened, never links.

A folder from an untrusted source can contain a symbolic or hard link, a pipe or a device in place of any file. A
program that followed such an entry would read, change or truncate a file of the user, or wait for ever. A command
therefore calls `require_enclosed` before it uses a folder, opens single files with `open_plain` or `read_plain`, and
checks other paths with `require_plain_within`.
"""

import os
import stat
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

from framework.errors import DataError, UserError, shorten

MOST_ENTRIES = 1_000_000
"""Largest number of files and folders in a run or sweep folder; a folder with more is refused."""
DEEPEST_FOLDERS = 64
"""Largest depth of folders within a run or sweep folder; Python's own functions fail at a few hundred."""
REMEDY = (
    "A run folder may come from an untrusted source, so only plain files in it are opened. Replace this entry by a "
    "copy of the file, or remove it."
)


def require_enclosed(folder: Path, error: type[UserError] = DataError) -> None:
    """Refuse a folder that contains anything but folders and plain files; accept a folder that does not exist.

    The folder itself may be a link, because its name comes from the user.

    Args:
        folder: Folder of a run or a sweep, or another folder that a command writes into.
        error: Class of the error.

    Raises:
        error: An entry is a link, has a second name elsewhere (a hard link), or is not a regular file. The message
            names the first such entry.
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise error(f"{shorten(folder)} is not a folder. Give the folder of a run.")
    folders, entry_count = [(os.fspath(folder), 0)], 0
    while folders:
        path, depth = folders.pop()
        if depth > DEEPEST_FOLDERS:
            raise error(
                f"{shorten(folder)} contains folders nested more than {DEEPEST_FOLDERS} levels deep, but no run has "
                "such folders. Give the folder of a run."
            )
        try:
            with os.scandir(path) as entries:
                for entry in entries:
                    entry_count += 1
                    status = entry.stat(follow_symlinks=False)
                    if fault := _fault(status):
                        raise error(f"{shorten(entry.path)} is {fault}. {REMEDY}")
                    if stat.S_ISDIR(status.st_mode):
                        folders.append((entry.path, depth + 1))
        except FileNotFoundError:  # the process that writes this run has removed the folder in the meantime
            continue
        except OSError as refused:
            raise error(
                f"{shorten(refused.filename or folder)} cannot be read ({refused.strerror}). Give a folder that you "
                "may read."
            ) from refused
        if entry_count > MOST_ENTRIES:
            raise error(
                f"{shorten(folder)} contains more than {MOST_ENTRIES:,} files, but no run has so many. Give the folder "
                "of a run."
            )


def require_plain_within(file: Path, folder: Path, error: type[UserError] = DataError) -> None:
    """Refuse a file whose path below `folder` contains a link; accept a missing file.

    Raises:
        error: The file or a folder on its path is an entry that `require_enclosed` refuses.
    """
    below = file.relative_to(folder)
    for part in (*reversed(below.parents[:-1]), below):
        path = folder / part
        try:
            status = path.lstat()
        except FileNotFoundError:
            return
        if fault := _fault(status):
            raise error(f"{shorten(path)} is {fault}. {REMEDY}")


FOLLOW_LINKS = "FRAMEWORK_FOLLOW_LINKS"
"""Environment variable with which a user allows links in data folders to lead to any other folder."""
_data_folders: set[str] = set()


def add_data_folder(path: str | os.PathLike[str]) -> None:
    """Let `require_inside_data` refuse the links of a folder that the user names for reading data; ignore a file."""
    folder = os.path.abspath(os.path.expanduser(path))  # noqa: PTH100, PTH111
    if os.path.isdir(folder):  # noqa: PTH112
        _data_folders.add(folder)


def require_inside_data(file: str | os.PathLike[str]) -> None:
    """Refuse a file of a data folder that is reached by a link out of the folder; accept any other file.

    A folder from another person could contain a link to a private image, which the figures of a run would show. The
    data folder itself may be a link, because its name comes from the user.

    Raises:
        DataError: The file is reached by such a link.
    """
    path = os.path.abspath(file)  # noqa: PTH100
    homes = [folder for folder in _data_folders if path.startswith(folder.rstrip(os.sep) + os.sep)]
    if not homes or os.environ.get(FOLLOW_LINKS) == "1":
        return
    parent, name = os.path.split(path)
    real = os.path.realpath(path) if os.path.islink(path) else os.path.join(_real_folder(parent), name)  # noqa: PTH114, PTH118
    if not any(real.startswith(_real_folder(home).rstrip(os.sep) + os.sep) for home in homes):
        raise DataError(
            f"{shorten(path)} is reached by a link that leads out of the folder {shorten(max(homes, key=len))}. The "
            "folder may come from an untrusted source, so such links are not followed. Replace the link by a copy or "
            f"a hard link or, if all links in the folder are your own, set the environment variable {FOLLOW_LINKS}=1."
        )


@lru_cache(maxsize=4096)
def _real_folder(folder: str) -> str:
    """Return the path of a folder without links. Results are kept, because many files lie in one folder."""
    return os.path.realpath(folder)


def open_plain(path: Path, flags: int) -> int:
    """Open a file of a run folder as `os.open` does, but never through a link, and return the descriptor.

    `flags` must not contain O_TRUNC, which would truncate the file before this function has checked it.

    Raises:
        DataError: The entry is a link, has a second name elsewhere (a hard link), or is not a regular file.
        OSError: The file cannot be opened.
    """
    assert not flags & os.O_TRUNC
    try:
        # without O_NONBLOCK, opening a pipe would wait for its other end
        descriptor = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o644)
    except OSError:
        if path.is_symlink():
            raise DataError(f"{shorten(path)} is a link. {REMEDY}") from None
        raise
    if fault := _fault(os.fstat(descriptor)):
        os.close(descriptor)
        raise DataError(f"{shorten(path)} is {fault}. {REMEDY}")
    return descriptor


def read_stream(path: Path) -> BinaryIO:
    """Open a file of a run folder for reading; the caller closes it. Raises the errors of `open_plain`."""
    return os.fdopen(open_plain(path, os.O_RDONLY), "rb")


def read_plain(path: Path, most: int) -> bytes:
    """Return the whole content of a file of a run folder.

    Raises:
        DataError: `open_plain` refuses the file, or it has more than `most` bytes.
        OSError: The file cannot be opened.
    """
    with read_stream(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        if size > most:
            raise DataError(
                f"{shorten(path)} has {size:,} bytes, but at most {most:,} bytes are read. Copy the file again from "
                "its source."
            )
        return stream.read(most + 1)


def _fault(status: os.stat_result) -> str:
    """Return the kind of a folder's entry that is forbidden, such as "a link"; "" for a folder or a plain file."""
    if stat.S_ISLNK(status.st_mode):
        return "a link"
    if stat.S_ISDIR(status.st_mode):
        return ""
    if not stat.S_ISREG(status.st_mode):
        return "not a regular file"
    return "" if status.st_nlink <= 1 else "a file that has a second name elsewhere (a hard link)"
