"""Location of the cache, in which generated data stay between runs."""

import os
from pathlib import Path

from framework.errors import DataError


def folder(name: str) -> Path:
    """Return the cache folder `name`, and create it if it is missing.

    The folder lies below FRAMEWORK_CACHE if that environment variable is set, else below XDG_CACHE_HOME or ~/.cache.

    Raises:
        DataError: The folder cannot be created.
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
            f"The cache folder {path} cannot be created ({error}). Set FRAMEWORK_CACHE to another folder."
        ) from error
    return path
