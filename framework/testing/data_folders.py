"""Folders in which a data set is prepared for a check, with a cache of their own, and damage to its files."""

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
    """Use a folder instead of the user's cache for data that are generated within the block."""
    before = os.environ.get("FRAMEWORK_CACHE")
    os.environ["FRAMEWORK_CACHE"] = str(folder)
    try:
        yield
    finally:
        del os.environ["FRAMEWORK_CACHE"]
        if before is not None:
            os.environ["FRAMEWORK_CACHE"] = before


class _Entries:
    """Result of `os.scandir` in reverse order of names."""

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
        """Do nothing, since no resource is open."""


@contextmanager
def listed_backwards() -> Iterator[None]:
    """List the files of folders in reverse order within the block, as another machine may do."""
    listdir, scandir = os.listdir, os.scandir
    os.listdir = lambda *path: sorted(listdir(*path), reverse=True)  # type: ignore[assignment]
    os.scandir = lambda *path: _Entries(scandir(*path))  # type: ignore[assignment]
    try:
        yield
    finally:
        os.listdir, os.scandir = listdir, scandir


class Place:
    """Folder for one preparation of a data set.

    Attributes:
        files: Folder of the files that the row's `write` made for the data set to read; empty for generated data.
        cache: Folder for generated data.
        source: Parameters that locate the written files.
    """

    def __init__(self, row: DataRow, folder: Path) -> None:
        self.files, self.cache = folder / "files", folder / "cache"
        self.files.mkdir(parents=True)
        self.source = dict(row.write(self.files)) if row.write else {}


class Workbench:
    """Builder of the data set of a row, which prepares it as often as checks need it.

    Args:
        row: Row of the data set.
        build: Function from parameters to the data set, not prepared.
        scratch: Empty folder.
    """

    def __init__(self, row: DataRow, build: Build, scratch: Path) -> None:
        self.row = row
        self.build = build
        self.scratch = scratch

    def folder(self) -> Path:
        """Return a new empty folder."""
        path = self.scratch / str(len(list(self.scratch.iterdir())))
        path.mkdir()
        return path

    def place(self) -> Place:
        """Return a new place with the row's files."""
        return Place(self.row, self.folder())

    def built(self, place: Place, **config: Any) -> Data:
        """Return the data set of a place, not prepared; `config` overrides the row's."""
        return self.build({**place.source, **self.row.config, **config})

    def prepared(self, place: Place, **config: Any) -> Data:
        """Return a prepared data set of a place; `config` overrides the row's."""
        data = self.built(place, **config)
        with cache_in(place.cache):
            data.prepare()
        return data

    @cached_property
    def first(self) -> Place:
        """Place of the first preparation."""
        return self.place()

    @cached_property
    def data(self) -> Data:
        """Data set that is prepared once, for checks that change nothing."""
        return self.prepared(self.first)

    @cached_property
    def again(self) -> Data:
        """Data set that is prepared a second time in the same place, so that generated data are read back."""
        return self.prepared(self.first)

    @cached_property
    def contents(self) -> dict[str, Contents]:
        """Contents of each split, by name."""
        return {name: contents(split) for name, split in parts(self.data).items()}

    @cached_property
    def says_where(self) -> list[str]:
        """Parameters that locate the data: those that `write` returned, else `root` where there is one."""
        if self.row.write is None:
            return ["root"] if "root" in inspect.signature(type(self.data)).parameters else []
        below = self.first.files
        return [key for key, value in self.first.source.items() if Path(str(value)).is_relative_to(below)]

    def default(self, key: str) -> Any:
        """Return the constructor's default value of a parameter."""
        return inspect.signature(type(self.data)).parameters[key].default

    @cached_property
    def generated(self) -> Path | None:
        """Folder that the first preparation generated in the official layout; None where there is none."""
        if self.row.write or self.row.config.get("root") or not self.says_where:
            return None
        return next((mark.parent for mark in sorted(self.first.cache.rglob(MARK))), None)

    def spoilt(self, spoil: Callable[[Path], None]) -> tuple[Place, dict[str, Any]]:
        """Return a copy of the data set's files, changed by `spoil`, and the parameters with which it is read."""
        place = self.place()
        if self.generated is None:
            spoil(place.files)
            return place, {}
        shutil.copytree(self.generated, place.files, dirs_exist_ok=True)
        spoil(place.files)
        return place, {"root": str(place.files)}


def damage(file: Path, kind: Damage) -> None:
    """Damage a file in the given way."""
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
    """Return the first file that matches a pattern.

    Raises:
        ValueError: No file matches the row's pattern.
    """
    found = sorted(path for path in folder.glob(pattern) if path.is_file())
    if not found:
        raise ValueError(f"the row's pattern {pattern!r} fits no file of its data set.")
    return found[0]


def configured(row: DataRow, own: Mapping[str, Any]) -> DataRow:
    """Return the row with a user's parameters added to its own.

    Where these parameters locate the data, nothing else of the row is kept. A user's data are read and never damaged,
    and the row cannot know their columns or which files are equivalent.
    """
    with TemporaryDirectory() as folder:
        says_where = {"root", *(row.write(Path(folder)) if row.write else ())}
    if says_where & set(own):
        return DataRow("as configured", own, leave_out={**SAID_BY_ROWS, **row.leave_out}, limits=row.limits)
    changes = {key: value for key, value in row.changes.items() if key not in own}
    return replace(row, name="as configured", config={**row.config, **own}, changes=changes)
