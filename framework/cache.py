"""Where generated data is kept between runs."""

import os
from pathlib import Path


def folder(name: str) -> Path:
    """The cache folder `name`, under FRAMEWORK_CACHE, else XDG_CACHE_HOME, else ~/.cache; made if missing."""
    root = os.environ.get("FRAMEWORK_CACHE")
    if not root:
        root = str(
            Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "robust-visual-learning"
        )
    path = Path(root).expanduser() / name
    path.mkdir(parents=True, exist_ok=True)
    return path
