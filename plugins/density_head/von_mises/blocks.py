"""Passes over many elements in blocks that fit a processor's cache."""

from collections.abc import Callable

import torch
from torch import Tensor

from plugins.density_head.von_mises.processor import is_transformed

BLOCK = 2**16
"""Number of elements of a block; the intermediate results of a block stay in the processor's cache."""


def in_blocks(function: Callable[..., tuple[Tensor, ...]], *arguments: Tensor) -> tuple[Tensor, ...]:
    """Return `function(*arguments)` for an elementwise function, computed block by block on the CPU.

    No blocks are used in compiled code, in transforms of torch.func, on other devices, for at most BLOCK elements, and
    for arguments of different shapes.
    """
    first = arguments[0]
    if (
        torch.compiler.is_compiling()
        or is_transformed()
        or first.device.type != "cpu"
        or first.numel() <= BLOCK
        or any(argument.shape != first.shape for argument in arguments)
    ):
        return function(*arguments)
    flat = [argument.detach().reshape(-1).split(BLOCK) for argument in arguments]
    results: list[Tensor] = []
    for start, parts in zip(range(0, first.numel(), BLOCK), zip(*flat, strict=True), strict=True):
        block = function(*parts)
        if not results:
            results = [torch.empty(first.numel(), dtype=part.dtype, device=part.device) for part in block]
        for result, part in zip(results, block, strict=True):
            result[start : start + BLOCK] = part
    return tuple(result.view(first.shape) for result in results)
