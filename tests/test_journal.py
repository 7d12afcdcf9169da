"""Tests of the journal: every written number can be read, even after interruptions."""

import errno
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.errors import DataError
from framework.storage.files import write_whole
from framework.tracking import journal as module
from framework.tracking.journal import Journal


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run" / "journal.jsonl"


def steps(journal: Journal) -> list[int]:
    return [line.step for line in journal.lines()]


def raw(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_what_is_written_is_read_back_at_once(path: Path) -> None:
    journal = Journal(path)
    journal.write({"train/loss": 0.1, "rate": 1e-3}, step=5, epoch=1)
    # Not closed, nor even flushed by hand: another process sees it.
    (line,) = Journal(path).lines()
    assert (line.step, line.epoch, line.values) == (5, 1, {"train/loss": 0.1, "rate": 1e-3})
    assert abs(line.time - path.stat().st_mtime) < 5
    journal.close()


@settings(deadline=None, max_examples=50)
@given(
    st.lists(
        st.tuples(
            st.dictionaries(st.text(max_size=8), st.floats(), max_size=4),
            st.integers(0, 10**12),
            st.integers(0, 10**6),
        ),
        max_size=6,
    )
)
def test_any_name_and_any_float_survive_as_valid_json(
    tmp_path_factory: pytest.TempPathFactory, records: list[tuple[dict[str, float], int, int]]
) -> None:
    path = tmp_path_factory.mktemp("journal") / "journal.jsonl"
    journal = Journal(path)
    for values, step, epoch in records:
        journal.write(values, step, epoch)
    journal.close()

    def no_constants(name: str) -> float:
        raise AssertionError(f"{name} is not JSON")

    for line in path.read_bytes().splitlines() if path.exists() else []:
        json.loads(line, parse_constant=no_constants)
    found = [(line.values, line.step, line.epoch) for line in Journal(path).lines()]
    # repr tells NaN from numbers, and -0.0 from 0.0
    assert repr(found) == repr(records)


def test_not_finite_values_are_names(path: Path) -> None:
    journal = Journal(path)
    journal.write({"a": math.nan, "b": math.inf, "c": -math.inf, "d": 1.0}, 0, 0)
    journal.close()
    assert raw(path)[0]["values"] == {"a": "nan", "b": "inf", "c": "-inf", "d": 1.0}


@pytest.mark.parametrize(
    "torn", [b'{"n":3,"ti', b'{"n":3,"time":1.0,"step":2,"epoch":0,"values":{}}', b"\0\0\0"]
)
def test_torn_last_line_is_left_out_and_cut_off_and_said(
    path: Path, torn: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    journal = Journal(path)
    journal.write({"a": 1.0}, 0, 0)
    journal.write({"a": 2.0}, 1, 0)
    journal.close()
    whole = path.read_bytes()
    path.write_bytes(whole + torn)

    again = Journal(path)
    assert steps(again) == [0, 1]
    assert path.read_bytes() == whole + torn  # reading changes nothing: the writer may be at it
    again.write({"a": 3.0}, 2, 0)
    again.close()
    assert steps(again) == [0, 1, 2]
    assert [record["n"] for record in raw(path)] == [1, 2, 3]
    assert f"({len(torn)} bytes)" in caplog.text


def test_damaged_line_in_the_middle_is_skipped_and_said(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    journal = Journal(path)
    for step in range(3):
        journal.write({"a": 1.0}, step, 0)
    journal.close()
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(lines[0] + b'{"n":2,"time":\n' + lines[2])
    assert steps(Journal(path)) == [0, 2]
    assert "damaged line" in caplog.text
    again = Journal(path)
    again.drop_after(0)
    again.close()
    assert b'{"n":2,"time":\n' in path.read_bytes()  # not ours to throw away


def test_numbers_go_on_after_reopening_and_after_a_known_number(path: Path) -> None:
    first = Journal(path)
    first.write({"a": 1.0}, 0, 0)
    first.append(tags={"b": "c"})
    first.close()
    second = Journal(path)
    second.open(after=7)  # a power cut took lines 3 to 7, which were stored elsewhere
    second.write({"a": 2.0}, 1, 0)
    second.close()
    assert [record["n"] for record in raw(path)] == [1, 2, 8]
    third = Journal(path)
    third.open(after=3)
    assert third.last == 8
    third.close()


def test_a_closed_journal_can_be_written_again(path: Path) -> None:
    journal = Journal(path)
    for step in range(3):
        journal.write({"a": 1.0}, step, 0)
        journal.close()
        journal.close()
    assert [record["n"] for record in raw(path)] == [1, 2, 3]


def test_reading_goes_on_where_it_ended_and_never_scans_again(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_BLOCK", 200)
    blocks: list[int] = []
    whole_lines = module._whole_lines

    def counted(file):
        block = whole_lines(file)
        blocks.append(len(block))
        return block

    monkeypatch.setattr(module, "_whole_lines", counted)
    journal = Journal(path)
    seen: list[int] = []
    for step in range(100):
        journal.write({"a": float(step)}, step, 0)
        if step % 7 == 0:
            while records := journal.read(seen[-1] if seen else 0):
                seen.extend(record["n"] for record in records)
    while records := journal.read(seen[-1]):
        seen.extend(record["n"] for record in records)
    assert seen == list(range(1, 101))
    assert journal.read(100) == []
    assert sum(blocks) == path.stat().st_size
    # From anywhere else it is found, too.
    assert journal.read(41)[0]["n"] == 42
    journal.close()


def test_a_line_longer_than_a_block(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_BLOCK", 16)
    journal = Journal(path)
    journal.append(tags={"long": "x" * 1000})
    journal.write({"a": 1.0}, 0, 0)
    assert [record["n"] for record in journal.read(0)] == [1]
    assert [record["n"] for record in journal.read(1)] == [2]
    journal.close()


def test_reading_where_nothing_is(path: Path) -> None:
    assert Journal(path).read() == []
    assert list(Journal(path).lines()) == []
    assert not path.parent.exists()


def test_drop_after_removes_later_steps_and_only_these(path: Path) -> None:
    journal = Journal(path)
    journal.append(params={"a": "b"})
    for step in range(10):
        journal.write({"a": float(step)}, step, 0)
    journal.append(artifact="x", folder="")
    assert journal.drop_after(6) == 3
    journal.write({"a": 70.0}, 7, 0)
    assert steps(journal) == [0, 1, 2, 3, 4, 5, 6, 7]
    journal.close()
    records = raw(path)
    assert [record["n"] for record in records] == [1, 2, 3, 4, 5, 6, 7, 8, 12, 13, 14]  # none is given twice
    assert records[-2]["resumed_after"] == 6
    assert [file.name for file in path.parent.iterdir() if "partial" in file.name] == []


def test_drop_after_on_a_full_disk_leaves_the_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = Journal(path)
    for step in range(3):
        journal.write({"a": 1.0}, step, 0)
    before = path.read_bytes()

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(module.os, "fsync", full)
        with pytest.raises(OSError, match="No space"):
            journal.drop_after(0)
    assert path.read_bytes() == before
    journal.write({"a": 1.0}, 3, 0)
    assert steps(journal) == [0, 1, 2, 3]
    assert [record["n"] for record in journal.read()] == [1, 2, 3, 4]
    journal.close()


def test_a_reader_that_is_behind_a_rewriting_finds_its_place(path: Path) -> None:
    journal = Journal(path)
    for step in range(6):
        journal.write({"a": 1.0}, step, 0)
    assert journal.read()[-1]["n"] == 6
    journal.drop_after(2)
    assert [record.get("resumed_after") for record in journal.read(6)] == [2]
    journal.close()


def test_set_aside_begins_anew(path: Path) -> None:
    journal = Journal(path)
    journal.write({"a": 1.0}, 0, 0)
    journal.set_aside(path.with_name("old.jsonl"))
    journal.write({"a": 2.0}, 9, 0)
    journal.close()
    assert steps(journal) == [9]
    assert [record["n"] for record in raw(path)] == [1]
    assert steps(Journal(path.with_name("old.jsonl"))) == [0]


class Disk:
    """Replacement of os.write that accepts a number of bytes and then reports a full disk."""

    def __init__(self, room: int, write: Callable[[int, bytes], int]) -> None:
        self.room, self.write = room, write

    def __call__(self, descriptor: int, data: bytes) -> int:
        if self.room == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        taken = self.write(descriptor, bytes(data[: self.room]))
        self.room -= taken
        return taken


@pytest.mark.parametrize("room", [0, 1, 100, 200])
def test_a_full_disk_stops_nobody_and_loses_nothing(
    path: Path, room: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    journal = Journal(path)
    journal.write({"a": -1.0}, 0, 0)
    disk = Disk(room, os.write)
    monkeypatch.setattr(module.os, "write", disk)
    for step in range(1, 50):
        journal.write({"a": float(step)}, step, 0)
    assert len(caplog.records) == 1
    assert "keeps its numbers in memory" in caplog.text
    disk.room = 1 << 30
    journal.write({"a": 50.0}, 50, 0)
    assert steps(journal) == list(range(51))
    journal.close()
    assert steps(journal) == list(range(51))


def test_lines_a_disk_never_took_are_counted(
    path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    journal = Journal(path)
    journal.write({"a": 0.0}, 0, 0)
    monkeypatch.setattr(module.os, "write", Disk(10, os.write))
    for step in range(1, 4):
        journal.write({"a": 1.0}, step, 0)
    journal.close()
    assert "last 3 lines" in caplog.text
    monkeypatch.undo()
    journal.write({"a": 1.0}, 4, 0)
    assert steps(journal) == [0, 4]
    journal.close()


def test_each_line_is_synced_soon_and_at_close(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[int] = []
    fsync = os.fsync

    def counted(descriptor: int) -> None:
        fsync(descriptor)
        synced.append(os.fstat(descriptor).st_size)

    monkeypatch.setattr(module.os, "fsync", counted)
    journal = Journal(path)
    for step in range(2000):
        journal.write({"a": 1.0}, step, 0)
    journal.close()
    assert synced[-1] == path.stat().st_size
    assert len(synced) < 100  # and not once a line


def test_one_writer_at_a_time(path: Path) -> None:
    program = (
        "import sys, pathlib; from framework.tracking.journal import Journal\n"
        "journal = Journal(pathlib.Path(sys.argv[1]))\n"
        "journal.write({'a': 1.0}, 0, 0); print('ready', flush=True); sys.stdin.read()"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", program, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    with other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"ready\n"
        journal = Journal(path)
        with pytest.raises(DataError, match=f"another process .number {other.pid}."):
            journal.write({"a": 2.0}, 1, 0)
        assert steps(journal) == [0]  # reading is free
        other.kill()
    journal.write({"a": 2.0}, 1, 0)  # the lock dies with its owner
    assert steps(journal) == [0, 1]
    journal.close()


def test_a_folder_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match=r"cannot be written \(.*Choose a run folder"):
        Journal(tmp_path / "file" / "journal.jsonl").write({"a": 1.0}, 0, 0)


def test_write_whole_replaces_all_or_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.json"
    write_whole(path, b"old")

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(module.os, "fsync", full)
        with pytest.raises(OSError, match="No space"):
            write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    write_whole(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]
