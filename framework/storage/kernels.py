"""Compiled functions that are cached on disk, and compiled again where one of their source files has changed."""

import os
from collections.abc import Callable, Iterable
from hashlib import sha256
from pathlib import Path
from typing import Any

from numba import config, njit

from framework.errors import DataError
from framework.storage.cache import folder


def kept_in(name: str, sources: Iterable[Path]) -> str | None:
    """Return the cache folder for functions that are compiled from these source files.

    Its name contains a hash of all the sources, because numba notices changes in a function's own file but not in the
    files of the functions that it calls. The folder lies below NUMBA_CACHE_DIR if that is set, else in the framework's
    cache. None is returned where it cannot be written; then every process compiles.
    """
    digest = sha256(b"".join(source.read_bytes() for source in sorted(sources))).hexdigest()[:16]
    try:
        given = vars(config)["CACHE_DIR"]
        root = Path(given) if given else folder("numba")
        kept = root / f"{name}-{digest}"
        kept.mkdir(parents=True, exist_ok=True)
    except (DataError, OSError):
        return None
    return str(kept) if os.access(kept, os.W_OK) else None


def compiler(place: str | None, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function for this processor at its first call.

    The compiled function has no bounds checks, releases the GIL, and computes as IEEE 754 prescribes unless `options`
    say otherwise.

    Args:
        place: Folder from `kept_in` that keeps the compiled function, or None to keep it in memory only.
        options: Further options of `numba.njit`.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        before = vars(config)["CACHE_DIR"]
        vars(config).update(CACHE_DIR=place or before)  # type: ignore[reportAttributeAccessIssue]  # njit reads it immediately
        try:
            return njit(nogil=True, error_model="numpy", cache=place is not None, **options)(function)
        finally:
            vars(config).update(CACHE_DIR=before)  # type: ignore[reportAttributeAccessIssue]

    return compiled
