"""The map from a raw parameter to a scale above 0 that several heads of real numbers share."""

import torch
from jaxtyping import Float
from torch import Tensor

LARGEST_SCALE = 1e12
"""Largest scale that a raw parameter gives."""


def scale_of_raw(raw: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return the scale for a raw parameter r: σ = exp(r) for r ≤ 0, and σ = (1 + r/4)⁴ for r > 0.

    σ is a smooth function of r, 1 at r = 0, and at most LARGEST_SCALE.

    The Fisher information of log σ is constant, so that a logarithmic map trains best. The fourth power keeps σ from
    exploding at an outlier.
    """
    most = 4 * (LARGEST_SCALE**0.25 - 1)
    high = (1 + raw.clamp(0.0, most) / 4).square().square()
    return torch.where(raw < 0, torch.exp(raw.clamp(max=0.0)), high)
