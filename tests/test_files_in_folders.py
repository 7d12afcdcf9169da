"""Tests of the files that `mode.files` selects in a folder, and of the messages about the others."""

import io
from itertools import product
from pathlib import Path

import pytest
from rich.console import Console

from framework.errors import DataError
from framework.runs.user_files import list_files, print_left_out

HELD = {"files": ("one.png", "two.PNG"), "folders": ("sub", "more"), "hidden": (".DS_Store", ".git")}


def made(folder: Path, *kinds: str) -> Path:
    """Make a folder with entries of these kinds; its subfolders contain files."""
    folder.mkdir()
    for name in (name for kind in kinds for name in HELD[kind]):
        if name in ("sub", "more", ".git"):
            (folder / name).mkdir()
            (folder / name / "inner.png").touch()
        else:
            (folder / name).touch()
    return folder


@pytest.mark.parametrize("files, folders, hidden", list(product([True, False], repeat=3)))
def test_files_are_those_of_the_folder_itself(
    tmp_path: Path, files: bool, folders: bool, hidden: bool
) -> None:
    kinds = [kind for kind, held in (("files", files), ("folders", folders), ("hidden", hidden)) if held]
    folder = made(tmp_path / "given", *kinds)
    if files:
        found, left_out = list_files(folder)
        assert [file.name for file in found] == ["one.png", "two.PNG"]
        said = io.StringIO()
        print_left_out(Console(file=said, width=200), "folders", "not looked into", left_out)
        assert said.getvalue() == ("2 folders not looked into: more, sub\n" if folders else "")
        assert list_files(folder / "one.png") == ([folder / "one.png"], [])
    else:
        why = (
            r"contains only folders \(more, sub\), which are not searched" if folders else "contains no file"
        )
        with pytest.raises(
            DataError, match=rf"given {why}\. Give the folder that directly contains the files"
        ):
            list_files(folder)
