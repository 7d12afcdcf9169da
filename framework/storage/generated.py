"""Generated data sets in the cache: written whole or not at all, by one process at a time, and marked as synthetic."""

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
"""Number of threads that draw files at the same time."""


def generated(root: Path, mark: Mapping[str, Any], write: Callable[[Path], None]) -> Path:
    """Return the folder `root` of generated data, after writing it if it does not exist.

    Args:
        root: Folder of the generated data.
        mark: Everything that the content depends on, as JSON values; stored beside the content in `synthetic.json`.
        write: Function that fills an empty folder, which is renamed to `root` when it is complete.

    Raises:
        DataError: The cache cannot be written, or `root` holds data with another mark.
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
    """Return the content of `synthetic.json` in a folder, or None where there is no such file: the data are recorded.

    Raises:
        DataError: The file cannot be read.
    """
    if not (root / MARK).exists():
        return None
    return read_json(root / MARK, "the mark of generated data", f"Delete {root}: it is made anew.")


def draw_all(count: int, draw: Callable[[int], None], what: str) -> None:
    """Call `draw` with 0 … count - 1, in several threads; `what` names the result in the progress report."""
    with ThreadPoolExecutor(PAINTERS) as painters:
        try:
            for _ in tracked(painters.map(draw, range(count)), f"drawing {what}", count, "files"):
                pass
        except BaseException:
            painters.shutdown(cancel_futures=True)
            raise


def _write(root: Path, mark: Mapping[str, Any], write: Callable[[Path], None]) -> None:
    part = root.with_name(f".{root.name}.part")
    # left by a process that was killed, because this one holds the lock
    shutil.rmtree(part, ignore_errors=True)
    try:
        part.mkdir()
        write(part)
        (part / MARK).write_text(json.dumps(dict(mark), indent=2) + "\n", encoding="utf-8")
        part.rename(root)
    finally:
        shutil.rmtree(part, ignore_errors=True)
