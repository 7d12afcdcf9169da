"""Selection of the files that a data set reads from a user's folder, which may contain other files too."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from framework.data import Data
from framework.errors import DataError
from framework.storage.enclosed import add_data_folder
from framework.storage.names import spell_name
from framework.storage.progress import track_progress

UNREADABLE = "unreadable.txt"
"""Name of the file that lists the files left out, one per line."""


def list_files(path: Path) -> tuple[list[Path], list[Path]]:
    """Return the files and the subfolders of the folder `path`, or the file `path` and no subfolders.

    Subfolders are not searched for files. Hidden files and folders are left out of both lists.

    Raises:
        DataError: The path does not exist, or the folder contains no file.
    """
    if not path.exists():
        raise DataError(f"mode.files={path} does not exist. Give a file, or a folder of files.")
    if path.is_file():
        return [path], []
    add_data_folder(path)
    items = sorted(item for item in path.iterdir() if not item.name.startswith("."))
    files = [item for item in items if item.is_file()]
    folders = [item for item in items if item.is_dir()]
    if not files:
        content = (
            f"contains only folders ({_list_paths(folders)}), which are not searched"
            if folders
            else "contains no file"
        )
        raise DataError(f"mode.files={path} {content}. Give the folder that directly contains the files.")
    return files, folders


def readable(data: Data, file: Path) -> bool:
    """Return whether the data set can read every sample of a file."""
    try:
        dataset = data.read([file])
        for index in range(len(dataset)):  # type: ignore[arg-type]
            dataset[index]
    except DataError:
        return False
    return True


def select_files(
    data: Data, files: Sequence[Path], config: Mapping[str, Any], console: Console
) -> tuple[list[Path], list[Path]]:
    """Return the files to read, and the files left out because they are damaged; print which files are not read.

    Three kinds of files are ignored:
    - hidden files,
    - files that are read together with another file (`Data.companions`),
    - files of other kinds, such as a README: the data set does not list their suffix, and no file with this suffix can
      be read. If this holds for all files, none of them is ignored.

    A remaining file that cannot be read stays in the list and causes an error later, unless `config` contains
    `unreadable=skip` or `skip_unreadable`.

    Raises:
        DataError: No file remains.
    """
    companions = {file for file in files if data.companions and file.name.lower().endswith(data.companions)}
    print_left_out(console, "files", "belong to other files and are read with them", sorted(companions))
    files = [file for file in files if file not in companions]
    kinds: dict[str, list[Path]] = {}
    for file in files:
        if not file.name.startswith("."):
            kinds.setdefault(file.suffix.lower(), []).append(file)
    read = {
        kind
        for kind, files_of_kind in kinds.items()
        if kind in data.suffixes or any(readable(data, file) for file in files_of_kind)
    }
    to_predict = [
        file for file in files if not file.name.startswith(".") and (not read or file.suffix.lower() in read)
    ]
    print_left_out(
        console,
        "files",
        "ignored, because they are of another kind",
        [file for file in files if file not in set(to_predict)],
    )
    if not to_predict:
        raise DataError(
            f"None of the {len(files) + len(companions)} files is of a kind that the data set reads. Give files of "
            "such a kind."
        )
    if config.get("unreadable") != "skip" and not config.get("skip_unreadable"):
        return to_predict, []
    unreadable = [
        file
        for file in track_progress(to_predict, "looking for damage", len(to_predict), "files")
        if not readable(data, file)
    ]
    print_left_out(console, "files", "left out, because they cannot be read", unreadable)
    if len(unreadable) == len(to_predict):
        raise DataError(
            f"None of the {len(to_predict)} files can be read. Give files that the data set reads."
        )
    return [file for file in to_predict if file not in set(unreadable)], unreadable


def print_left_out(console: Console, kind: str, why: str, paths: Sequence[Path]) -> None:
    """Print the names of files or folders that are not read, with their kind and the reason, if there are any."""
    if paths:
        console.print(f"{len(paths)} {kind} {why}: {_list_paths(paths)}", soft_wrap=True, highlight=False)


def _list_paths(paths: Sequence[Path]) -> str:
    return ", ".join(spell_name(path.name) for path in paths[:10]) + (", …" if len(paths) > 10 else "")
