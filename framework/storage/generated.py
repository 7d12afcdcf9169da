"""Generated data in the cache: written whole or not at all, by one process at a time, and marked as synthetic."""

import json
import shutil
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from framework.errors import DataError
from framework.storage.files import alone
from framework.storage.plain_values import read_json
from framework.storage.progress import tracked

MARK = "synthetic.json"
PAINTERS = 2
"""Threads that draw at once."""


def generated(root: Path, mark: Mapping[str, Any], write: Callable[[Path], None]) -> Path:
    """The generated `root` itself; written now unless it is there.

    `write` fills an empty folder, which takes its place when it is whole. `mark` holds everything the content
    depends on, as JSON values; it is kept beside the content in `synthetic.json`.

    Raises:
        DataError: the cache cannot be written, or holds something else in its place.
    """
    try:
        root.parent.mkdir(parents=True, exist_ok=True)
        if not root.exists():
            with alone(root.with_name(f".{root.name}.lock")):
                if not root.exists():  # another process may have written it while this one waited
                    _write(root, mark, write)
    except OSError as error:
        raise DataError(
            f"Generated data cannot be written to {root} ({error}). Free space there, or set FRAMEWORK_CACHE to "
            "another folder."
        ) from error
    if read_mark(root) != mark:
        raise DataError(
            f"{root / MARK} does not describe {dict(mark)}; it was changed. Delete {root}: it is made anew."
        )
    return root


def read_mark(root: Path) -> dict[str, Any] | None:
    """What `synthetic.json` says of a root; None where there is none: the data are real.

    Raises:
        DataError: the file cannot be read.
    """
    if not (root / MARK).exists():
        return None
    return read_json(root / MARK, "the mark of generated data", f"Delete {root}: it is made anew.")


def draw_all(count: int, draw: Callable[[int], None], what: str) -> None:
    """Call `draw` with 0 … count - 1, some at once; `what` is drawn."""
    with ThreadPoolExecutor(PAINTERS) as painters:
        try:
            for _ in tracked(painters.map(draw, range(count)), f"drawing {what}", count, "files"):
                pass
        except BaseException:
            painters.shutdown(cancel_futures=True)
            raise


def _write(root: Path, mark: Mapping[str, Any], write: Callable[[Path], None]) -> None:
    part = root.with_name(f".{root.name}.part")
    shutil.rmtree(part, ignore_errors=True)  # of a process that was killed: the lock is ours
    try:
        part.mkdir()
        write(part)
        (part / MARK).write_text(json.dumps(dict(mark), indent=2) + "\n", encoding="utf-8")
        part.rename(root)
    finally:
        shutil.rmtree(part, ignore_errors=True)
