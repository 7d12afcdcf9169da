"""Contents of parsed files, kept in the cache so that later commands do not parse unchanged files again."""

import os
import stat
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from pydantic import ConfigDict, TypeAdapter

from framework.errors import DataError
from framework.storage import cache
from framework.storage.files import write_whole
from framework.storage.first_rank import first_rank
from framework.storage.reading import read_bytes

Content = TypeVar("Content")
SETTLED = 2_000_000_000
"""Age in nanoseconds from which a change of a file changes its time stamps.

Some file systems store times in whole seconds, so that two changes within one second leave the same time stamp.
"""
LARGEST = 2**26
"""Largest size in bytes of a file with contents; larger ones are neither written nor read."""


class Stamp(NamedTuple):
    """Properties of a file that change when the file is written or replaced.

    Attributes:
        size: Size, bytes.
        modified: Time of the last change of the bytes, nanoseconds.
        changed: Time of the last change of the bytes or of the properties, nanoseconds.
        number: Number of the file in its file system.
    """

    size: int
    modified: int
    changed: int
    number: int


class ParsedFiles(Generic[Content]):
    """Contents of the files in one folder, as far as the files have not changed since an earlier command parsed them.

    The cache holds the contents in one JSON file with a checksum. This file is ignored if it is damaged. It is not used
    after a change of `sources`, because the parser may then read the files differently.

    Args:
        folder: Folder of the files.
        name: Name of the kind of contents; it begins the name of the file in the cache.
        content: Type of the contents: a dataclass or another type that pydantic validates.
        sources: Source files of the parser.
    """

    def __init__(self, folder: Path, name: str, content: Any, sources: Iterable[Path]) -> None:
        self.folder = folder
        key = sha256(b"".join(source.read_bytes() for source in sources))
        key.update(os.fsencode(folder.resolve()))
        self._name = f"{name}-{key.hexdigest()[:32]}.json"
        self._adapter: TypeAdapter[dict[str, tuple[Stamp, Content]]] = TypeAdapter(
            dict[str, tuple[Stamp, content]],  # pyright: ignore[reportInvalidTypeForm]  # known only at run time
            config=ConfigDict(ser_json_inf_nan="constants"),
        )
        self._contents: dict[str, tuple[Stamp, Content]] = {}
        self._new = False
        with suppress(DataError, OSError, ValueError):  # it is missing or damaged, so the files are parsed
            self._contents = self._read()

    def get(self, file: Path, parse: Callable[[Path], Content]) -> Content:
        """Return the content of a file in the folder; the file is parsed if it is new or has changed.

        All errors of `parse` are raised, and no content is then kept.
        """
        name = os.fspath(file.relative_to(self.folder))
        stamp = _stamp(file)
        known = self._contents.get(name)
        if known is not None and known[0] == stamp:
            return known[1]
        content = parse(file)
        if stamp is not None and time.time_ns() - max(stamp.modified, stamp.changed) > SETTLED:
            self._contents[name] = stamp, content
            self._new = True
        return content

    def save(self) -> None:
        """Write the contents to the cache if files were parsed; if the cache cannot be written, nothing is kept."""
        if not self._new or not first_rank():
            return
        with suppress(DataError, OSError, ValueError):
            content = self._adapter.dump_json(self._contents)
            if len(content) < LARGEST:
                write_whole(self._file(), f"{sha256(content).hexdigest()}\n".encode() + content)
                self._new = False

    def _file(self) -> Path:
        return cache.folder("parsed_files") / self._name

    def _read(self) -> dict[str, tuple[Stamp, Content]]:
        if self._file().stat().st_size > 2 * LARGEST:
            raise ValueError("the file is too large")
        checksum, _, content = read_bytes(self._file()).partition(b"\n")
        if checksum != sha256(content).hexdigest().encode():
            raise ValueError("the checksum is wrong")
        return self._adapter.validate_json(content, strict=True)


def _stamp(file: Path) -> Stamp | None:
    """Return the stamp of a regular file, or None if the path is anything else."""
    try:
        status = os.stat(file)  # noqa: PTH116 - called for thousands of files
    except OSError:
        return None
    if not stat.S_ISREG(status.st_mode):
        return None
    return Stamp(status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino)
