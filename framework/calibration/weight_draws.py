"""Standard normal noise from which wrappers draw weights, the same noise in every call."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

SEED = 40
"""Seed of the noise from which weights are drawn."""


def weight_noise(draw: int, size: int) -> Float[Tensor, "size"]:
    """Return the standard normal numbers of one draw of `size` weights, float64, on the CPU.

    The numbers are always the same, so that a model gives the same prediction in every mode and batch. A draw with an
    odd number is the negative of the draw before it: the mean over an even number of draws is then exact (antithetic
    variates; Hammersley & Morton 1956).
    """
    # NumPy, because an export would replace random numbers of torch; these are the same in all versions
    generator = np.random.RandomState([SEED, draw // 2])
    noise = torch.from_numpy(generator.standard_normal(size))
    return -noise if draw % 2 else noise
