"""An entry of a run folder is opened only if it is a plain file of that folder."""

import os
import shutil
import socket
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from framework.configuration.newest import newest_run
from framework.configuration.registry import installed
from framework.configuration.schema import build, resolve
from framework.datasets.fields import fetch
from framework.errors import CheckpointError, ConfigError, DataError
from framework.storage.enclosed import (
    DEEPEST_FOLDERS,
    FOLLOW_LINKS,
    add_data_folder,
    open_plain,
    read_plain,
    require_enclosed,
    require_plain_within,
)
from framework.storage.reading import open_regular, read_bytes
from framework.testing.contract import contract
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


FOLDERS = [
    (name, number)
    for name in installed("data")
    for number, row in enumerate(contract("data", name).rows)
    if row.write is not None
]


@pytest.mark.parametrize(("name", "number"), FOLDERS)
def test_no_link_leads_out_of_a_data_folder(name: str, number: int, tmp_path: Path) -> None:
    """Test links to files and links to folders, for all data sets whose contract row names a folder."""
    row = contract("data", name).rows[number]
    home, outside = tmp_path / "home", tmp_path / "outside"
    home.mkdir()
    settings = row.write(home)
    config = resolve("data", {"name": name, **row.config, **settings})
    if not any(Path(str(value)).is_dir() for value in settings.values()):
        pytest.skip("the user names single files, which may be links")
    home.rename(outside)
    for linked in ("files", "folders"):
        home.mkdir()
        for path in sorted(outside.iterdir()):
            if linked == "folders" or path.is_file():
                (home / path.name).symlink_to(path)
                continue
            for file in sorted(path.rglob("*")):
                target = home / file.relative_to(outside)
                target.parent.mkdir(parents=True, exist_ok=True)
                if file.is_dir():
                    target.mkdir(exist_ok=True)
                else:
                    target.symlink_to(file)
        with pytest.raises(DataError, match=f"is reached by a link .* {FOLLOW_LINKS}=1"):
            data = build("data", config)
            data.prepare()
            fetch(data.splits().train, [0])
        shutil.rmtree(home)


def test_links_within_a_data_folder_and_links_of_the_user_are_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "disk" / "all").mkdir(parents=True)
    (tmp_path / "disk" / "all" / "a.txt").write_text("a")
    (tmp_path / "disk" / "b.txt").symlink_to("all/a.txt")
    (tmp_path / "disk" / "some").symlink_to("all")
    (tmp_path / "disk" / "out.txt").symlink_to(tmp_path / "out.txt")
    (tmp_path / "out.txt").write_text("out")
    (tmp_path / "data").symlink_to("disk")
    add_data_folder(tmp_path / "data")
    for name in ("all/a.txt", "b.txt", "some/a.txt", "../data/some/a.txt"):
        assert read_bytes(tmp_path / "data" / name) == b"a"
    with pytest.raises(DataError, match=r"out\.txt is reached by a link"):
        read_bytes(tmp_path / "data" / "out.txt")
    assert read_bytes(tmp_path / "disk" / "out.txt") == b"out", "the user names this path"
    monkeypatch.setenv(FOLLOW_LINKS, "1")
    assert read_bytes(tmp_path / "data" / "out.txt") == b"out"
    monkeypatch.delenv(FOLLOW_LINKS)
    add_data_folder(tmp_path)  # all of the link's target lies in a folder that the user names
    assert read_bytes(tmp_path / "data" / "out.txt") == b"out"


def test_a_sparse_file_is_refused_before_it_is_read(tmp_path: Path) -> None:
    """Refuse a terabyte of zeros with a few bytes at the beginning, in the middle or at the end; read a small file."""
    file = tmp_path / "one.x"
    for place in (0, 2**36, 2**40 - 9):
        with file.open("wb") as stream:
            stream.seek(place)
            stream.write(b"content")
            stream.truncate(2**40)
        with pytest.raises(
            ValueError, match=r"sparse: of its 1099511627776 bytes only \d+ are stored.*`cp --sparse"
        ):
            open_regular(file)
    with file.open("wb") as stream:
        stream.write(bytes(2**20))
        stream.truncate(2**20 * 18)
    with open_regular(file) as stream:
        assert stream.read(3) == b"\0\0\0"
