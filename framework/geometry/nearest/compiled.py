"""Compiles the functions beside it for this processor, once: machine code is kept below the framework's cache."""

import os
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any, no_type_check

from numba import config, njit, types
from numba.core.extending import intrinsic

from framework.errors import DataError
from framework.storage.cache import folder

PARTS = "compiled", "lanes", "pack", "search", "processor"
"""Files whose functions call each other."""


def kept_in() -> str | None:
    """A folder of this source's own, since numba looks for changes in a function's file but not in what it calls.

    Below NUMBA_CACHE_DIR, else the framework's cache; None where that cannot be written: then every process compiles.
    """
    sources = (Path(__file__).with_name(f"{part}.py") for part in PARTS)
    digest = sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()[:16]
    try:
        given = vars(config)["CACHE_DIR"]
        root = Path(given) if given else folder("numba")
        kept = root / f"nearest-{digest}"
        kept.mkdir(parents=True, exist_ok=True)
    except (DataError, OSError):
        return None
    return str(kept) if os.access(kept, os.W_OK) else None


KEPT_IN = kept_in()


def compiled(function: Callable[..., Any]) -> Any:
    """Without bounds checks or the GIL; real numbers as IEEE 754 has them: no fastmath."""
    before = vars(config)["CACHE_DIR"]
    vars(config).update(CACHE_DIR=KEPT_IN or before)  # type: ignore[reportAttributeAccessIssue]  # read here and now
    try:
        return njit(nogil=True, error_model="numpy", cache=KEPT_IN is not None)(function)
    finally:
        vars(config).update(CACHE_DIR=before)  # type: ignore[reportAttributeAccessIssue]


def inlined(function: Callable[..., Any]) -> Any:
    """A part of compiled functions that is written into each of them, so that vectors stay in registers."""
    return njit(inline="always", error_model="numpy")(function)


@intrinsic
@no_type_check
def taken_from(typing, counter, number):
    """counter[0], an int64, which grows by the number in the same moment: of several threads each gets another."""

    def generate(context, builder, sig, values):
        array = context.make_array(sig.args[0])(context, builder, values[0])
        return builder.atomic_rmw("add", array.data, values[1], "seq_cst")

    return types.int64(counter, types.int64), generate
