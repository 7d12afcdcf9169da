"""Compilation of this package's functions for the CPU; machine code is kept below the framework's cache."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, no_type_check

from numba import njit, types
from numba.core.extending import intrinsic

from framework.storage.kernels import compiler, kernel_cache

PARTS = "compiled", "pack", "search", "processor"
"""Names of the files whose compiled functions call each other; after a change in one file, all are compiled again."""


KEPT_IN = kernel_cache("nearest", (Path(__file__).with_name(f"{part}.py") for part in PARTS))
compiled = compiler(KEPT_IN)


def inlined(function: Callable[..., Any]) -> Any:
    """Return `function`, compiled so that it is inlined into each compiled caller; vectors then stay in registers."""
    return njit(inline="always", error_model="numpy")(function)


@intrinsic
@no_type_check
def fetch_and_add(typing, counter, number):
    """Return counter[0], an int64, and add `number` to it atomically, so that several threads get different values.

    Call it as `fetch_and_add(counter, number)`; numba passes `typing`.
    """

    def generate(context, builder, sig, values):
        array = context.make_array(sig.args[0])(context, builder, values[0])
        return builder.atomic_rmw("add", array.data, values[1], "seq_cst")

    return types.int64(counter, types.int64), generate
