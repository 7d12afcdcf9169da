"""The projected normal head: the direction of a normal vector for each angle."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from framework.density_head import DensityHead
from framework.heads.parameters import require_finite
from framework.target import Target
from plugins.density_head.projected_normal.density import ProjectedNormal

LARGEST_MEAN = 1e6
"""Largest |μ|; it gives a standard deviation of a microradian, which is the resolution of float32 angles."""
LARGEST_FACTOR = 3.0
"""Bound of s and t, so that standard deviations in two directions differ by a factor of a few hundred at most."""


class ProjectedNormalHead(DensityHead):
    """One projected normal density for each angle (Mardia & Jupp 2000, §3.5.6; Wang & Gelfand 2013).

    For each angle the head reads a pair (x, y) and, with `shape="general"`, s and t. The mean of the normal vector is μ
    = (x, y) √(1 + (x² + y²)/16), so that the concentration |μ|² grows with the fourth power of the length of (x, y). s
    and t are bounded smoothly by LARGEST_FACTOR. The uniform density is x = y = s = t = 0.

    Args:
        shape: "general": any covariance, so that the density may be skewed or have two peaks; "isotropic": the unit
            matrix, a symmetric density with one peak.
    """

    bibtex = "mardia2000directional, wang2013directional"

    def __init__(self, target: Target, *, shape: Literal["general", "isotropic"] = "general") -> None:
        super().__init__()
        target.require("angle", by="density_head projected_normal")
        self.angles = len(target.names)
        self.general = shape == "general"
        self.size = self.angles * (4 if self.general else 2)

    def forward(self, raw: Float[Tensor, "*batch size"]) -> ProjectedNormal:
        raw = require_finite(raw, self.size)
        numbers = raw.double().unflatten(-1, (self.angles, -1))
        mean = mean_of_raw(numbers[..., :2])
        factor = torch.zeros_like(mean)
        if self.general:
            factor = LARGEST_FACTOR * torch.tanh(numbers[..., 2:] / LARGEST_FACTOR)
        return ProjectedNormal(mean, factor, raw.dtype)


def mean_of_raw(raw: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
    """Return μ = (x, y) √(1 + (x² + y²)/16), at most LARGEST_MEAN long."""
    raw = raw.clamp(-1e100, 1e100)  # so that squares do not overflow
    square = raw.square().sum(-1, keepdim=True)
    # where the bound applies, the length is at least 1; the clamp avoids the square root at 0, which has no gradient
    return raw * torch.minimum((1 + square / 16).sqrt(), LARGEST_MEAN / square.clamp(min=1).sqrt())
