"""Weights that depend only on their names and shapes, to compare a network with a published one of the same names."""

import hashlib
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor


def weights_of_names(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return float32 weights for all names of a state; they depend only on its names and shapes.

    Convolutions have the variance 2 / (number of inputs), factors of batch norm are near 1, offsets are near 0, and
    stored variances are above 0.
    """
    generator, weights = np.random.default_rng(0), {}
    for name in sorted(state):
        shape = tuple(state[name].shape)
        if name.endswith("num_batches_tracked"):
            weights[name] = torch.tensor(0)
            continue
        values = generator.normal(size=shape)
        if name.endswith("running_var"):
            values = np.exp(values / 2)
        elif len(shape) == 1:
            values = values / 4 + ("weight" in name)
        else:
            values = values * np.sqrt(2 / np.prod(shape[1:]))
        weights[name] = torch.tensor(values, dtype=torch.float32)
    return weights


def hash_names_and_shapes(state: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of the sorted names of a state and of their shapes."""
    text = "\n".join(f"{name} {tuple(tensor.shape)}" for name, tensor in sorted(state.items()))
    return hashlib.sha256(text.encode()).hexdigest()
