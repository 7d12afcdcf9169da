"""Compilation of functions that are cached on disk and compiled again if one of their source files has changed."""

import os
import sys
import time
from collections.abc import Callable, Iterable
from hashlib import sha256
from pathlib import Path
from threading import Timer
from typing import Any

from numba import config, njit
from numba.core import event

from framework.errors import DataError
from framework.storage.cache import folder
from framework.storage.first_rank import first_rank
from framework.storage.progress import QUIET_TIME
from framework.storage.working_directory import refuse_settings

refuse_settings(("numba",))  # before compiled code is loaded from a folder that the settings name


def kernel_cache(name: str, sources: Iterable[Path]) -> str | None:
    """Return the cache folder for functions that are compiled from these source files.

    The name of the folder contains a hash of all the sources, because numba notices changes in a function's own file
    but not in the files of the functions that it calls. The folder lies below NUMBA_CACHE_DIR if that is set, else in
    the framework's cache. If the folder cannot be written, the function returns None, and every process compiles the
    functions itself.
    """
    digest = sha256(b"".join(source.read_bytes() for source in sorted(sources))).hexdigest()[:16]
    try:
        user_folder = vars(config)["CACHE_DIR"]
        root = Path(user_folder) if user_folder else folder("numba")
        cache_folder = root / f"{name}-{digest}"
        cache_folder.mkdir(parents=True, exist_ok=True)
    except (DataError, OSError):
        return None
    return str(cache_folder) if os.access(cache_folder, os.W_OK) else None


def compiler(cache_folder: str | None, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function for this processor at its first call.

    The compiled function has no bounds checks, releases the GIL, and computes as IEEE 754 prescribes unless `options`
    say otherwise.

    Args:
        cache_folder: Folder from `kernel_cache` for the compiled function, or None to keep it in memory only.
        options: Further options of `numba.njit`.
    """

    def compile_function(function: Callable[..., Any]) -> Any:
        before = vars(config)["CACHE_DIR"]
        vars(config).update(CACHE_DIR=cache_folder or before)  # type: ignore[reportAttributeAccessIssue]  # njit reads it immediately
        try:
            return njit(nogil=True, error_model="numpy", cache=cache_folder is not None, **options)(function)
        finally:
            vars(config).update(CACHE_DIR=before)  # type: ignore[reportAttributeAccessIssue]

    return compile_function


class _Announcement(event.Listener):
    """Listener that prints one line as soon as this process has compiled for `QUIET_TIME` seconds in all."""

    def __init__(self) -> None:
        self._depth = 0  # a function is compiled while its caller is
        self._seconds = 0.0
        self._start = 0.0
        self._timer: Timer | None = None
        self._printed = False

    def on_start(self, event: object) -> None:
        """Start a timer for the rest of the quiet time."""
        self._depth += 1
        if self._depth == 1 and not self._printed:
            self._start = time.monotonic()
            self._timer = Timer(max(0.0, QUIET_TIME - self._seconds), self._print)
            self._timer.daemon = True
            self._timer.start()

    def on_end(self, event: object) -> None:
        """Stop the timer."""
        self._depth -= 1
        if self._depth == 0 and self._timer is not None:
            self._timer.cancel()
            self._timer = None
            self._seconds += time.monotonic() - self._start

    def _print(self) -> None:
        self._printed = True
        if first_rank():
            sys.stderr.write("compiling functions for this processor; the cache keeps them for later runs\n")


event.register("numba:compile", _Announcement())
