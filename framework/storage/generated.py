"""Generated data sets in the cache, which one process at a time writes and which are marked as synthetic."""

import json
import shutil
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from framework.errors import DataError
from framework.storage.files import hold_lock
from framework.storage.plain_values import read_json
from framework.storage.progress import track_progress

MARK = "synthetic.json"
PAINTERS = 2
"""Number of threads that draw files at the same time."""


def ensure_generated(root: Path, mark: Mapping[str, Any], write: Callable[[Path], None]) -> Path:
    """Generate data in the folder `root` if the folder does not exist, and return the folder.

    Args:
        root: Folder of the generated data.
        mark: Settings that determine the generated data, as JSON values; the file `synthetic.json` in the folder stores
            them, and they distinguish generated from recorded data.
        write: Function that writes the data into an empty folder, which is renamed to `root` when it is complete.

    Raises:
        DataError: The cache cannot be written, or `root` contains data with another mark.
    """
    try:
        root.parent.mkdir(parents=True, exist_ok=True)
        if not root.exists():
            with hold_lock(root.with_name(f".{root.name}.lock")):
                if not root.exists():  # another process may have written the data while this one waited
                    _write(root, mark, write)
    except OSError as error:
        raise DataError(
            f"Generated data cannot be written to {root} ({error}). Free space there, or set FRAMEWORK_CACHE to "
            "another folder."
        ) from error
    if read_mark(root) != mark:
        raise DataError(
            f"{root / MARK} does not describe {dict(mark)}, so this file was changed. Delete {root}; the data are then "
            "generated again."
        )
    return root


def read_mark(root: Path) -> dict[str, Any] | None:
    """Return the content of `synthetic.json` in a folder, or None if the file is missing, as for recorded data.

    Raises:
        DataError: The file cannot be read.
    """
    if not (root / MARK).exists():
        return None
    return read_json(
        root / MARK, "the mark of generated data", f"Delete {root}; the data are then generated again."
    )


def draw_all(count: int, draw: Callable[[int], None], name: str) -> None:
    """Call `draw` with 0 … count - 1 in several threads; the progress report calls the drawn files `name`."""
    with ThreadPoolExecutor(PAINTERS) as painters:
        try:
            for _ in track_progress(painters.map(draw, range(count)), f"drawing {name}", count, "files"):
                pass
        except BaseException:
            painters.shutdown(cancel_futures=True)
            raise


def _write(root: Path, mark: Mapping[str, Any], write: Callable[[Path], None]) -> None:
    part = root.with_name(f".{root.name}.part")
    # this process holds the lock, so the process that left such a folder was killed
    shutil.rmtree(part, ignore_errors=True)
    try:
        part.mkdir()
        write(part)
        (part / MARK).write_text(json.dumps(dict(mark), indent=2) + "\n", encoding="utf-8")
        part.rename(root)
    finally:
        shutil.rmtree(part, ignore_errors=True)
