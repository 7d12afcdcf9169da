"""Which files of a user's folder a data set reads: others may lie beside them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from framework.data import Data
from framework.errors import DataError
from framework.storage.names import spelled
from framework.storage.progress import tracked

UNREADABLE = "unreadable.txt"
"""The files that were left out, a line each."""


def readable(data: Data, file: Path) -> bool:
    """Whether every sample of a file can be read."""
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
    """The files to read, and those left out because they cannot be read; `console` is told of what is not read.

    Hidden files are ignored, and files whose suffix is not one of the data set's and of which it can read none (a
    README, a table), or that belong to others (`Data.companions`). What then cannot be read stays, and is an error
    later; where the data's `config` says to skip it, it is left out.
    """
    beside = {file for file in files if data.companions and file.name.lower().endswith(data.companions)}
    _tell(console, "belong to others and are read with them", sorted(beside))
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
    _tell(console, "ignored, being of another kind", [file for file in files if file not in set(kept)])
    if config.get("unreadable") != "skip" and not config.get("skip_unreadable"):
        return kept, []
    bad = [
        file for file in tracked(kept, "looking for damage", len(kept), "files") if not readable(data, file)
    ]
    _tell(console, "left out, since they cannot be read", bad)
    if len(bad) == len(kept):
        raise DataError(f"None of {len(kept)} files can be read. Give files that the data set reads.")
    return [file for file in kept if file not in set(bad)], bad


def _tell(console: Console, what: str, files: Sequence[Path]) -> None:
    if files:
        named = ", ".join(spelled(file.name) for file in files[:10]) + (", …" if len(files) > 10 else "")
        console.print(f"{len(files)} files {what}: {named}", soft_wrap=True, highlight=False)
