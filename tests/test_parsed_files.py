"""Contents of parsed files: kept while a file is unchanged, and never taken from a damaged or foreign cache file."""

import math
import os
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import pytest

from framework.storage import parsed_files
from framework.storage.parsed_files import ParsedFiles


@dataclass(frozen=True)
class Line:
    text: str
    numbers: tuple[float, float] | None


class Parser:
    """Parser of a text file that remembers which files it has parsed."""

    def __init__(self) -> None:
        self.parsed: list[str] = []

    def __call__(self, file: Path) -> Line:
        self.parsed.append(file.name)
        text, *numbers = file.read_text().split()
        return Line(text, (float(numbers[0]), float(numbers[1])) if numbers else None)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with two files; files that were written just now count as settled."""
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(parsed_files, "SETTLED", -(10**9))
    folder = tmp_path / "files"
    folder.mkdir()
    (folder / "a").write_text("é nan -inf")
    (folder / "b").write_text("bee")
    return folder


def read(folder: Path, sources: tuple[Path, ...] = ()) -> tuple[list[Line], list[str]]:
    """Return the contents of both files, and the names of those that had to be parsed."""
    files, parser = ParsedFiles[Line](folder, "lines", Line, sources), Parser()
    contents = [files.get(folder / name, parser) for name in ("a", "b")]
    files.save()
    return contents, parser.parsed


def kept_file(folder: Path) -> Path:
    """Return the file in the cache that holds the contents."""
    (file,) = (folder.parent / "cache" / "parsed_files").iterdir()
    return file


def test_unchanged_files_are_parsed_once_and_keep_every_number(folder: Path) -> None:
    first, parsed = read(folder)
    assert parsed == ["a", "b"]
    second, parsed = read(folder)
    assert parsed == []
    assert repr(second) == repr(first)
    assert second[0].numbers is not None
    assert math.isnan(second[0].numbers[0])


def test_a_changed_file_is_parsed_again_even_if_its_size_and_time_are_restored(folder: Path) -> None:
    read(folder)
    before = (folder / "b").stat()
    (folder / "b").write_text("bug")
    os.utime(folder / "b", ns=(before.st_atime_ns, before.st_mtime_ns))
    contents, parsed = read(folder)
    assert (contents[1].text, parsed) == ("bug", ["b"])
    (folder / "new").write_text("bat")
    os.utime(folder / "new", ns=(before.st_atime_ns, before.st_mtime_ns))
    (folder / "new").replace(folder / "b")
    contents, parsed = read(folder)
    assert (contents[1].text, parsed) == ("bat", ["b"])
    (folder / "b").unlink()
    with pytest.raises(FileNotFoundError):
        read(folder)


def test_a_file_that_has_just_been_written_is_not_kept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parsed_files, "SETTLED", 10**12)
    assert read(folder)[1] == ["a", "b"]
    assert read(folder)[1] == ["a", "b"]


def test_another_version_of_the_parser_or_another_folder_parses_again(folder: Path, tmp_path: Path) -> None:
    source = tmp_path / "parser.py"
    source.write_text("version 1")
    read(folder, (source,))
    assert read(folder, (source,))[1] == []
    source.write_text("version 2")
    assert read(folder, (source,))[1] == ["a", "b"]
    copy = tmp_path / "copy"
    copy.mkdir()
    for name in ("a", "b"):
        os.link(folder / name, copy / name)
    assert read(copy, (source,))[1] == ["a", "b"]


def signed(content: bytes) -> bytes:
    return sha256(content).hexdigest().encode() + b"\n" + content


def with_a_wrong_type(whole: bytes) -> bytes:
    return signed(whole.partition(b"\n")[2].replace(b'"bee"', b"7"))


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda whole: b"",
    "cut short": lambda whole: whole[:-5],
    "one letter changed": lambda whole: whole.replace(b"bee", b"bed"),
    "no checksum": lambda whole: whole.partition(b"\n")[2],
    "a wrong type": with_a_wrong_type,
    "a list": lambda whole: signed(b"[1, 2]"),
    "a number of many digits": lambda whole: signed(b"9" * 10_000),
    "deeply nested": lambda whole: signed(b"[" * 100_000),
    "no text": lambda whole: signed(b"\xff\xfe\x00"),
    "a pickle": lambda whole: pickle.dumps({"a": 1}),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_cache_file_is_ignored_and_replaced(damage: str, folder: Path) -> None:
    first, _ = read(folder)
    whole = kept_file(folder).read_bytes()
    kept_file(folder).write_bytes(DAMAGES[damage](whole))
    second, parsed = read(folder)
    assert parsed == ["a", "b"]
    assert repr(second) == repr(first)
    assert read(folder)[1] == []


def test_a_pipe_or_a_folder_in_place_of_the_cache_file_is_ignored(folder: Path) -> None:
    read(folder)
    file = kept_file(folder)
    file.unlink()
    os.mkfifo(file)
    assert read(folder)[1] == ["a", "b"]
    file.unlink()
    file.mkdir()
    assert read(folder)[1] == ["a", "b"]


def test_files_are_read_without_a_cache(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FRAMEWORK_CACHE", str(folder / "a"))  # a file
    assert read(folder)[1] == ["a", "b"]


def test_too_much_is_not_kept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parsed_files, "LARGEST", 10)
    assert read(folder)[1] == ["a", "b"]
    assert not list((folder.parent / "cache").rglob("*.json"))
