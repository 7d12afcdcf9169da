"""Passes over many elements in blocks that fit a processor's cache."""

from collections.abc import Callable

import torch
from torch import Tensor

BLOCK = 2**16
"""Number of elements of a pass on a processor without a compiler: its intermediate results stay in the cache."""


def in_blocks(function: Callable[..., tuple[Tensor, ...]], *arguments: Tensor) -> tuple[Tensor, ...]:
    """Return the elementwise function, in blocks for arguments of one shape; otherwise, and compiled, at once."""
    first = arguments[0]
    if (
        torch.compiler.is_compiling()
        or first.device.type != "cpu"
        or first.numel() <= BLOCK
        or any(argument.shape != first.shape for argument in arguments)
    ):
        return function(*arguments)
    flat = [argument.detach().reshape(-1).split(BLOCK) for argument in arguments]
    results: list[Tensor] = []
    for start, parts in zip(range(0, first.numel(), BLOCK), zip(*flat, strict=True), strict=True):
        made = function(*parts)
        if not results:
            results = [torch.empty(first.numel(), dtype=part.dtype, device=part.device) for part in made]
        for result, part in zip(results, made, strict=True):
            result[start : start + BLOCK] = part
    return tuple(result.view(first.shape) for result in results)
