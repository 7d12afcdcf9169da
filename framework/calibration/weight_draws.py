"""Standard normal noise from which wrappers draw weights, the same noise in every call."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

SEED = 40
"""Seed of the noise."""


def weight_noise(samples: int, size: int) -> Float[Tensor, "samples size"]:
    """Return standard normal numbers for `samples` draws of `size` weights, float64, on the CPU.

    The numbers are always the same, so that a model gives the same prediction in every mode and batch. The first rows
    do not depend on the number of rows. Each row with an odd number is the negative of the row before it: the mean over
    an even number of draws is then exact (antithetic variates; Hammersley & Morton 1956).
    """
    # NumPy, because an export would replace random numbers of torch; these are the same in all versions
    generator = np.random.RandomState(SEED)
    half = torch.from_numpy(generator.standard_normal(((samples + 1) // 2, size)))
    return torch.stack([half, -half], 1).flatten(0, 1)[:samples]
