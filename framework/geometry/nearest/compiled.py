"""Compiles the functions beside it for this processor, once: machine code is kept below the framework's cache."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, no_type_check

from numba import njit, types
from numba.core.extending import intrinsic

from framework.storage.kernels import compiler, kept_in

PARTS = "compiled", "lanes", "pack", "search", "processor"
"""Files whose functions call each other."""


KEPT_IN = kept_in("nearest", (Path(__file__).with_name(f"{part}.py") for part in PARTS))
compiled = compiler(KEPT_IN)


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
