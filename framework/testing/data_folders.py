"""Folders in which checks prepare a data set, each with its own cache, and damage to the files of a data set."""

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
from framework.testing.data_samples import Contents, hash_split, splits_by_name
from framework.testing.finding import SEED
from framework.testing.rows import NEEDS_ROWS, Damage, DataRow

Build = Callable[[Mapping[str, Any]], Data]


@contextmanager
def cache_in(folder: Path) -> Iterator[None]:
    """Generate data in `folder`, instead of in the user's cache, within the `with` block."""
    before = os.environ.get("FRAMEWORK_CACHE")
    os.environ["FRAMEWORK_CACHE"] = str(folder)
    try:
        yield
    finally:
        del os.environ["FRAMEWORK_CACHE"]
        if before is not None:
            os.environ["FRAMEWORK_CACHE"] = before


class _Entries:
    """Iterator like that of `os.scandir`, but sorted by name in reverse order."""

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
def list_folders_backwards() -> Iterator[None]:
    """List the files of folders in reverse order within the `with` block.

    A data set must not depend on this order, which differs between file systems.
    """
    listdir, scandir = os.listdir, os.scandir
    os.listdir = lambda *path: sorted(listdir(*path), reverse=True)  # type: ignore[assignment]
    os.scandir = lambda *path: _Entries(scandir(*path))  # type: ignore[assignment]
    try:
        yield
    finally:
        os.listdir, os.scandir = listdir, scandir


class Workspace:
    """Folder for one preparation of a data set.

    Args:
        row: Contract row of the data set, whose `write` writes files to the folder.
        folder: The folder.

    Attributes:
        files: Folder of the files that the row's `write` wrote; empty for generated data.
        cache: Folder for generated data.
        source: Parameters of the data set that name the written files.
    """

    def __init__(self, row: DataRow, folder: Path) -> None:
        self.files, self.cache = folder / "files", folder / "cache"
        self.files.mkdir(parents=True)
        self.source = dict(row.write(self.files)) if row.write else {}


class Workbench:
    """Object that builds and prepares the data set of a contract row as often as the checks need.

    Args:
        row: Contract row of the data set.
        build: Function that returns the data set for given parameters, without preparing it.
        scratch: Empty folder for the files of all preparations.
    """

    def __init__(self, row: DataRow, build: Build, scratch: Path) -> None:
        self.row = row
        self.build = build
        self.scratch = scratch

    def make_folder(self) -> Path:
        """Return a new empty folder."""
        path = self.scratch / str(len(list(self.scratch.iterdir())))
        path.mkdir()
        return path

    def make_workspace(self) -> Workspace:
        """Return a new workspace, to which the files of the contract row are written."""
        return Workspace(self.row, self.make_folder())

    def build_in(self, workspace: Workspace, **config: Any) -> Data:
        """Build the data set in a workspace without preparing it; `config` overrides the row's parameters."""
        return self.build({**workspace.source, **self.row.config, **config})

    def prepare_in(self, workspace: Workspace, **config: Any) -> Data:
        """Build and prepare the data set in a workspace; `config` overrides the row's parameters."""
        data = self.build_in(workspace, **config)
        with cache_in(workspace.cache):
            data.prepare()
        return data

    @cached_property
    def first(self) -> Workspace:
        """Workspace of the first preparation."""
        return self.make_workspace()

    @cached_property
    def data(self) -> Data:
        """Data set of the first preparation, for checks that do not change it."""
        return self.prepare_in(self.first)

    @cached_property
    def again(self) -> Data:
        """Data set of a second preparation in the same workspace, where generated data are read back from the cache."""
        return self.prepare_in(self.first)

    @cached_property
    def contents(self) -> dict[str, Contents]:
        """Name of each split → hashes of its samples."""
        return {name: hash_split(split) for name, split in splits_by_name(self.data).items()}

    @cached_property
    def location_keys(self) -> list[str]:
        """Names of the parameters that locate the data.

        They are the parameters for which the row's `write` returned a path in its folder. For a row without `write`,
        the only one is `root`, if the data set has this parameter.
        """
        if self.row.write is None:
            return ["root"] if "root" in inspect.signature(type(self.data)).parameters else []
        folder = self.first.files
        return [key for key, value in self.first.source.items() if Path(str(value)).is_relative_to(folder)]

    def default(self, key: str) -> Any:
        """Return the default value of the parameter `key` of the data set's constructor."""
        return inspect.signature(type(self.data)).parameters[key].default

    @cached_property
    def generated(self) -> Path | None:
        """Folder of generated files in the official layout, from the first preparation; None if there is none."""
        if self.row.write or self.row.config.get("root") or not self.location_keys:
            return None
        return next((mark.parent for mark in sorted(self.first.cache.rglob(MARK))), None)

    def copy_files(self, change: Callable[[Path], None]) -> tuple[Workspace, dict[str, Any]]:
        """Copy the data set's files and apply `change` to the folder of the copy.

        Returns:
            The workspace of the copy, and the parameters with which the data set reads the copy.
        """
        workspace = self.make_workspace()
        if self.generated is None:
            change(workspace.files)
            return workspace, {}
        shutil.copytree(self.generated, workspace.files, dirs_exist_ok=True)
        change(workspace.files)
        return workspace, {"root": str(workspace.files)}


def damage(file: Path, kind: Damage) -> None:
    """Damage a file in the way that `kind` names (see `framework.testing.rows.Damage`)."""
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
    """Return the first file in `folder`, in order of names, that matches the glob pattern `pattern`.

    Raises:
        ValueError: No file matches the pattern.
    """
    matches = sorted(path for path in folder.glob(pattern) if path.is_file())
    if not matches:
        raise ValueError(
            f"The pattern {pattern!r} of `fragile` matches no file in {folder}. Correct the pattern in rows.py."
        )
    return matches[0]


def configured_row(row: DataRow, own: Mapping[str, Any]) -> DataRow:
    """Return a contract row with the parameters of `row`, overridden by a user's parameters `own`.

    If `own` locates the data, only the limits and the list of properties that are not tested are taken from `row`. The
    files are then the user's own: they are read but not damaged, and the row does not know their columns.
    """
    with TemporaryDirectory() as folder:
        location_keys = {"root", *(row.write(Path(folder)) if row.write else ())}
    if location_keys & set(own):
        return DataRow("as configured", own, leave_out={**NEEDS_ROWS, **row.leave_out}, limits=row.limits)
    changes = {key: value for key, value in row.changes.items() if key not in own}
    return replace(row, name="as configured", config={**row.config, **own}, changes=changes)
