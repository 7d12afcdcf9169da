"""Standard normal noise from which wrappers draw weights; every call returns the same noise."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

SEED = 40
"""Seed of the noise from which weights are drawn."""


def weight_noise(draw: int, size: int) -> Float[Tensor, "size"]:
    """Return the standard normal numbers from which a wrapper draws `size` weights, float64, on the CPU.

    The numbers depend on `draw` and `size` only, so that a model gives the same prediction in every mode and batch. A
    draw with an odd number is the negative of the draw before it, so the mean of the first 2 k draws is exactly 0 for
    every k (antithetic variates; Hammersley & Morton 1956).

    Args:
        draw: Number of the draw, from 0.
        size: Number of weights.
    """
    # NumPy, because an export would replace random numbers of torch; these are the same in all versions
    generator = np.random.RandomState([SEED, draw // 2])
    noise = torch.from_numpy(generator.standard_normal(size))
    return -noise if draw % 2 else noise
