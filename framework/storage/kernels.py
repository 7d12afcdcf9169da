"""Compiled functions that are kept on disk, and made anew where a file that has part in them has changed."""

import os
from collections.abc import Callable, Iterable
from hashlib import sha256
from pathlib import Path
from typing import Any

from numba import config, njit

from framework.errors import DataError
from framework.storage.cache import folder


def kept_in(name: str, sources: Iterable[Path]) -> str | None:
    """A folder of these sources' own, since numba looks for changes in a function's file but not in what it calls.

    Below NUMBA_CACHE_DIR, else the framework's cache; None where that cannot be written: then every process compiles.
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
    """A decorator: compiled for this processor at the first call, kept in a folder of `kept_in`.

    Without bounds checks or the GIL; real numbers as IEEE 754 has them, unless `options` of numba.njit say otherwise.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        before = vars(config)["CACHE_DIR"]
        vars(config).update(CACHE_DIR=place or before)  # type: ignore[reportAttributeAccessIssue]  # read here and now
        try:
            return njit(nogil=True, error_model="numpy", cache=place is not None, **options)(function)
        finally:
            vars(config).update(CACHE_DIR=before)  # type: ignore[reportAttributeAccessIssue]

    return compiled
