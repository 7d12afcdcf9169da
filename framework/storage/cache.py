"""Where generated data is kept between runs."""

import os
from pathlib import Path

from framework.errors import DataError


def folder(name: str) -> Path:
    """The cache folder `name`, under FRAMEWORK_CACHE, else XDG_CACHE_HOME, else ~/.cache; made if missing.

    Raises:
        DataError: it cannot be made.
    """
    root = os.environ.get("FRAMEWORK_CACHE")
    if not root:
        root = str(
            Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "robust-visual-learning"
        )
    path = Path(root).expanduser() / name
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(
            f"The cache folder {path} cannot be made ({error}). Set FRAMEWORK_CACHE to another folder."
        ) from error
    return path
