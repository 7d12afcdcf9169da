"""Functions of shapes and indices that torch has too, but whose first call in torch imports SymPy for half a second."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """Return the shape to which tensors of the given shapes are broadcast.

    Raises:
        ValueError: The shapes do not fit each other.
    """
    return torch.Size(np.broadcast_shapes(*map(tuple, shapes)))


def unravel_index(index: Tensor, shape: Sequence[int]) -> tuple[Tensor, ...]:
    """Convert indices into a flattened tensor of shape `shape` to one index for each dimension of the tensor."""
    parts: list[Tensor] = []
    for size in reversed(shape):
        parts.append(index % size)
        index = index // size
    return tuple(reversed(parts))
