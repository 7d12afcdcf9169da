"""Folders in which a data set is prepared for a check: its own files, a cache of its own, and what happens to files."""

import inspect
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from framework.data import Data
from framework.storage.generated import MARK
from framework.testing.data_samples import Contents, contents, parts
from framework.testing.finding import SEED
from framework.testing.rows import SAID_BY_ROWS, Damage, DataRow

Build = Callable[[Mapping[str, Any]], Data]


@contextmanager
def cache_in(folder: Path) -> Iterator[None]:
    """What is generated meanwhile goes to this folder, and not to the user's cache."""
    before = os.environ.get("FRAMEWORK_CACHE")
    os.environ["FRAMEWORK_CACHE"] = str(folder)
    try:
        yield
    finally:
        del os.environ["FRAMEWORK_CACHE"]
        if before is not None:
            os.environ["FRAMEWORK_CACHE"] = before


class _Entries:
    """What `os.scandir` gives, in another order."""

    def __init__(self, entries: Any) -> None:
        with entries:
            self.entries = iter(sorted(entries, key=lambda entry: entry.name, reverse=True))

    def __iter__(self) -> Iterator[Any]:
        return self.entries

    def __next__(self) -> Any:
        return next(self.entries)

    def __enter__(self) -> Iterator[Any]:
        return self.entries

    def __exit__(self, *raised: object) -> None:
        pass

    def close(self) -> None:
        """Nothing is open."""


@contextmanager
def listed_backwards() -> Iterator[None]:
    """Folders list their files in another order meanwhile, as on another machine."""
    listdir, scandir = os.listdir, os.scandir
    os.listdir = lambda *path: sorted(listdir(*path), reverse=True)  # type: ignore[assignment]
    os.scandir = lambda *path: _Entries(scandir(*path))  # type: ignore[assignment]
    try:
        yield
    finally:
        os.listdir, os.scandir = listdir, scandir


class Place:
    """A folder of its own for one preparation.

    Attributes:
        files: where the row's `write` has put what the data set reads; empty for a generated one.
        cache: where generated data go.
        source: the parameters that say where the written files are.
    """

    def __init__(self, row: DataRow, folder: Path) -> None:
        self.files, self.cache = folder / "files", folder / "cache"
        self.files.mkdir(parents=True)
        self.source = dict(row.write(self.files)) if row.write else {}


class Workbench:
    """Builds and prepares the data set of one row as often as its checks ask for it.

    Args:
        row: whose data set it is.
        build: parameters → the data set, not prepared.
        scratch: an empty folder.
    """

    def __init__(self, row: DataRow, build: Build, scratch: Path) -> None:
        self.row = row
        self.build = build
        self.scratch = scratch

    def folder(self) -> Path:
        """A new empty folder."""
        path = self.scratch / str(len(list(self.scratch.iterdir())))
        path.mkdir()
        return path

    def place(self) -> Place:
        return Place(self.row, self.folder())

    def built(self, place: Place, **config: Any) -> Data:
        """The data set of what lies in a place, not prepared; `config` counts for more than the row's."""
        return self.build({**place.source, **self.row.config, **config})

    def prepared(self, place: Place, **config: Any) -> Data:
        data = self.built(place, **config)
        with cache_in(place.cache):
            data.prepare()
        return data

    @cached_property
    def first(self) -> Place:
        return self.place()

    @cached_property
    def data(self) -> Data:
        """Prepared once, for checks that change nothing."""
        return self.prepared(self.first)

    @cached_property
    def again(self) -> Data:
        """Prepared in the same place once more: of generated data what was written is read."""
        return self.prepared(self.first)

    @cached_property
    def contents(self) -> dict[str, Contents]:
        """Of every split."""
        return {name: contents(split) for name, split in parts(self.data).items()}

    @cached_property
    def says_where(self) -> list[str]:
        """The parameters that say where the data are: those of what was written, else `root` where there is one."""
        if self.row.write is None:
            return ["root"] if "root" in inspect.signature(type(self.data)).parameters else []
        below = self.first.files
        return [key for key, value in self.first.source.items() if Path(str(value)).is_relative_to(below)]

    def default(self, key: str) -> Any:
        """What the constructor takes where a parameter is not given."""
        return inspect.signature(type(self.data)).parameters[key].default

    @cached_property
    def generated(self) -> Path | None:
        """What the first preparation has generated in the official layout; None where there is no such thing."""
        if self.row.write or self.row.config.get("root") or not self.says_where:
            return None
        return next((mark.parent for mark in sorted(self.first.cache.rglob(MARK))), None)

    def spoilt(self, spoil: Callable[[Path], None]) -> tuple[Place, dict[str, Any]]:
        """Another copy of what was written or generated, after `spoil`, and the parameters that have it read."""
        place = self.place()
        if self.generated is None:
            spoil(place.files)
            return place, {}
        shutil.copytree(self.generated, place.files, dirs_exist_ok=True)
        spoil(place.files)
        return place, {"root": str(place.files)}


def damage(file: Path, kind: Damage) -> None:
    """Do to a file what its name says."""
    content = file.read_bytes()
    file.unlink()
    if kind == "empty":
        file.write_bytes(b"")
    elif kind == "cut":
        file.write_bytes(content[: len(content) // 2])
    elif kind == "garbage":
        file.write_bytes(b"\xff\x00" + np.random.default_rng(SEED).bytes(1022))
    elif kind == "folder":
        file.mkdir()


def first_match(folder: Path, pattern: str) -> Path:
    """The first file of a pattern.

    Raises:
        ValueError: the row names a pattern that no file has.
    """
    found = sorted(path for path in folder.glob(pattern) if path.is_file())
    if not found:
        raise ValueError(f"the row's pattern {pattern!r} fits no file of its data set.")
    return found[0]


def configured(row: DataRow, own: Mapping[str, Any]) -> DataRow:
    """The row with a user's own parameters beside its own.

    Where they say where the data are, nothing of the row is left: a user's data are read and never damaged, and the row
    cannot know which columns they have, or which files are like them.
    """
    with TemporaryDirectory() as folder:
        says_where = {"root", *(row.write(Path(folder)) if row.write else ())}
    if says_where & set(own):
        return DataRow("as configured", own, leave_out={**SAID_BY_ROWS, **row.leave_out}, limits=row.limits)
    changes = {key: value for key, value in row.changes.items() if key not in own}
    return replace(row, name="as configured", config={**row.config, **own}, changes=changes)
