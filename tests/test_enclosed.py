"""An entry of a run folder is opened only if it is a plain file of that folder."""

import os
import socket
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from framework.configuration.newest import newest_run
from framework.errors import CheckpointError, ConfigError, DataError
from framework.storage.enclosed import (
    DEEPEST_FOLDERS,
    open_plain,
    read_plain,
    require_enclosed,
    require_plain_within,
)
from framework.tracking import journal as journals
from framework.tracking.journal import Journal

SECRET = "a line of the user's own\nand one that does not end"


def linked(place: Path, outside: Path) -> None:
    place.symlink_to(outside)


def dangling(place: Path, outside: Path) -> None:
    place.symlink_to(outside.with_name("made through the link"))


def hard_linked(place: Path, outside: Path) -> None:
    place.hardlink_to(outside)


def piped(place: Path, outside: Path) -> None:
    os.mkfifo(place)


def listened(place: Path, outside: Path) -> None:
    with socket.socket(socket.AF_UNIX) as channel:
        channel.bind(os.path.relpath(place))


KINDS = [linked, dangling, hard_linked, piped, listened]


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    file = tmp_path / "mine.txt"
    file.write_text(SECRET)
    return file


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("below", ["", "a", "a/.b"])
def test_nothing_but_plain_files_is_opened(
    kind: Callable[[Path, Path], None], below: str, tmp_path: Path, outside: Path
) -> None:
    folder = tmp_path / "run"
    (folder / below).mkdir(parents=True)
    (folder / "run.json").touch()
    require_enclosed(folder)
    place = folder / below / "file"
    require_plain_within(place, folder)  # missing
    kind(place, outside)
    for error in (DataError, ConfigError, CheckpointError):
        with pytest.raises(error, match=r"file is (a link|not a regular file|a file that has a second name)"):
            require_enclosed(folder, error)
        with pytest.raises(error, match=r"file is "):
            require_plain_within(place, folder, error)
    for flags in (os.O_RDONLY, os.O_RDWR | os.O_CREAT, os.O_WRONLY | os.O_APPEND | os.O_CREAT):
        with pytest.raises((DataError, OSError)):
            open_plain(place, flags)
    with pytest.raises((DataError, OSError)):
        read_plain(place, 100)
    assert outside.read_text() == SECRET
    assert not outside.with_name("made through the link").exists()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["journal.jsonl", ".journal.jsonl.lock"])
def test_a_journal_follows_no_link(
    kind: Callable[[Path, Path], None], name: str, tmp_path: Path, outside: Path
) -> None:
    (tmp_path / "run").mkdir()
    kind(tmp_path / "run" / name, outside)
    with pytest.raises(DataError):
        Journal(tmp_path / "run" / "journal.jsonl").open()
    if name == "journal.jsonl":
        with pytest.raises(DataError):
            Journal(tmp_path / "run" / "journal.jsonl").read()
    assert outside.read_text() == SECRET


def test_a_folder_may_be_reached_by_a_link_that_the_user_names(tmp_path: Path) -> None:
    (tmp_path / "big disk" / "run").mkdir(parents=True)
    (tmp_path / "outputs").symlink_to(tmp_path / "big disk")
    (tmp_path / "latest").symlink_to(tmp_path / "outputs" / "run")
    for folder in (tmp_path / "outputs" / "run", tmp_path / "latest"):
        require_enclosed(folder)
        with os.fdopen(open_plain(folder / "run.json", os.O_RDWR | os.O_CREAT), "w") as file:
            file.write("{}")
        assert read_plain(folder / "run.json", 2) == b"{}"
        with pytest.raises(DataError, match=r"2 bytes, but at most 1 bytes are read"):
            read_plain(folder / "run.json", 1)
    require_enclosed(tmp_path / "nowhere")
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="is not a folder"):
        require_enclosed(tmp_path / "file")


def test_folders_nested_deeper_than_python_can_walk_are_refused(tmp_path: Path) -> None:
    """Python's `os.walk` and `Path.rglob` fail at a few hundred levels."""
    run = tmp_path / "run"
    checkpoints = run / "/".join("a" * DEEPEST_FOLDERS)
    checkpoints.mkdir(parents=True)
    require_enclosed(run)
    folder = os.open(checkpoints, os.O_RDONLY)
    for _ in range(1200):
        os.mkdir("a", dir_fd=folder)
        inner = os.open("a", os.O_RDONLY, dir_fd=folder)
        os.close(folder)
        folder = inner
    os.close(folder)
    for error in (DataError, ConfigError):
        with pytest.raises(error, match=r"nested more than 64 levels deep.* Give the folder of a run\.$"):
            require_enclosed(run, error)
    with pytest.raises(CheckpointError, match="no run in that folder has a checkpoint"):
        newest_run(run)
    subprocess.run(["rm", "-r", run], check=True)  # pytest cannot remove it


def test_a_link_to_a_folder_on_the_way_is_refused(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "model.ckpt").touch()
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "checkpoints").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(DataError, match="checkpoints is a link"):
        require_plain_within(tmp_path / "run" / "checkpoints" / "model.ckpt", tmp_path / "run")


def test_a_journal_is_bounded_in_size_and_in_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journals, "LONGEST", 1000)
    path = tmp_path / "journal.jsonl"
    path.write_bytes(b'{"n":7,"time":1}\n' + b"x" * 5000)
    with pytest.raises(DataError, match="no readable line in its last 2,000 bytes"):
        Journal(path).open()
    assert path.stat().st_size == 5017
    assert Journal(path).read() == [{"n": 7, "time": 1}]
    os.truncate(path, journals.LARGEST + 1)  # sparse
    with pytest.raises(DataError, match=r"at most 1,073,741,824 are read"):
        Journal(path).open()


@pytest.mark.parametrize(
    "line", ['"step":"x"', '"step":[1],"status":"RUNNING"', '"time":{},"status":"KILLED"', '"epoch":null']
)
def test_a_line_with_a_place_that_is_no_number_is_damaged(line: str, tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    path.write_text(f'{{"n":1,"time":1}}\n{{"n":2,{line}}}\n')
    journal = Journal(path)
    assert [record["n"] for record in journal.read()] == [1]
    assert journal.drop_after(0) == 0
    journal.close()
