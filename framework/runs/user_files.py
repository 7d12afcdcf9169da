"""Choice of the files that a data set reads from a user's folder, which may hold other files too."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from framework.data import Data
from framework.errors import DataError
from framework.storage.names import spell_name
from framework.storage.progress import track_progress

UNREADABLE = "unreadable.txt"
"""Name of the file that lists the files left out, one per line."""


def files_in(path: Path) -> tuple[list[Path], list[Path]]:
    """Return the files to read, and the folders inside `path`, which are not searched.

    The files are `path` itself, or the files in it. Hidden files and folders are left out of both lists.

    Raises:
        DataError: There is no file.
    """
    if not path.exists():
        raise DataError(f"mode.files={path} does not exist. Give a file, or a folder of files.")
    if path.is_file():
        return [path], []
    items = sorted(item for item in path.iterdir() if not item.name.startswith("."))
    files = [item for item in items if item.is_file()]
    folders = [item for item in items if item.is_dir()]
    if not files:
        held = (
            f"holds folders alone ({_listed(folders)}), which are not looked into"
            if folders
            else "holds no file"
        )
        raise DataError(
            f"mode.files={path} {held}. Give a folder that itself holds the files to predict for."
        )
    return files, folders


def readable(data: Data, file: Path) -> bool:
    """Return whether every sample of a file can be read."""
    try:
        dataset = data.read([file])
        for index in range(len(dataset)):  # type: ignore[arg-type]
            dataset[index]
    except DataError:
        return False
    return True


def to_read(
    data: Data, files: Sequence[Path], config: Mapping[str, Any], console: Console
) -> tuple[list[Path], list[Path]]:
    """Return the files to read, and the files left out because they cannot be read; print which files are not read.

    Three kinds of files are ignored: hidden files, files that belong to others (`Data.companions`), and files with a
    suffix that is not one of the data set's if the data set can read none of them (a README, a table). A remaining file
    that cannot be read stays in the list and causes an error later, unless `config` says to skip such files.

    Raises:
        DataError: No file remains.
    """
    beside = {file for file in files if data.companions and file.name.lower().endswith(data.companions)}
    say_left_out(console, "files", "belong to others and are read with them", sorted(beside))
    files = [file for file in files if file not in beside]
    kinds: dict[str, list[Path]] = {}
    for file in files:
        if not file.name.startswith("."):
            kinds.setdefault(file.suffix.lower(), []).append(file)
    read = {
        kind
        for kind, some in kinds.items()
        if kind in data.suffixes or any(readable(data, file) for file in some)
    }
    kept = [
        file for file in files if not file.name.startswith(".") and (not read or file.suffix.lower() in read)
    ]
    say_left_out(
        console, "files", "ignored, being of another kind", [file for file in files if file not in set(kept)]
    )
    if not kept:
        raise DataError(
            f"None of {len(files) + len(beside)} files is one to predict for. Give files that the data set reads."
        )
    if config.get("unreadable") != "skip" and not config.get("skip_unreadable"):
        return kept, []
    bad = [
        file
        for file in track_progress(kept, "looking for damage", len(kept), "files")
        if not readable(data, file)
    ]
    say_left_out(console, "files", "left out, since they cannot be read", bad)
    if len(bad) == len(kept):
        raise DataError(f"None of {len(kept)} files can be read. Give files that the data set reads.")
    return [file for file in kept if file not in set(bad)], bad


def say_left_out(console: Console, kind: str, why: str, paths: Sequence[Path]) -> None:
    """Print the names of files or folders that are not read, if there are any."""
    if paths:
        console.print(f"{len(paths)} {kind} {why}: {_listed(paths)}", soft_wrap=True, highlight=False)


def _listed(paths: Sequence[Path]) -> str:
    return ", ".join(spell_name(path.name) for path in paths[:10]) + (", …" if len(paths) > 10 else "")
