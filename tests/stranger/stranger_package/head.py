"""A density head on the circle that the framework does not ship."""

import math
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from framework.density_head import DensityHead
from framework.distributions.circular import circular
from framework.distributions.protocol import marginal
from framework.distributions.symmetric import Symmetric
from framework.heads.parameters import require_finite
from framework.target import Target


class WrappedCauchy(Symmetric):
    """Independent wrapped Cauchy densities (Mardia & Jupp 2000, eq. 3.5.66) over the last dimension."""

    support = circular

    def __init__(self, mean: Tensor, gap: Tensor) -> None:
        super().__init__(mean)
        self.gap = gap  # 1 - ρ, where ρ is the mean resultant length

    def log_prob(self, value: Tensor) -> Tensor:
        gap, length = self.gap, 1 - self.gap
        near = gap**2 + 4 * length * torch.sin((value - self.location) / 2) ** 2  # 1 + ρ² - 2ρ cos(φ-μ)
        return (torch.log(gap * (1 + length)) - near.log() - math.log(2 * math.pi)).sum(-1)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        like = {"dtype": self.location.dtype, "device": self.location.device}
        uniform = torch.rand(*sample_shape, *self.location.shape, **like)
        scale = self.gap / (2 - self.gap)
        return self.location + 2 * torch.atan(scale * torch.tan(math.pi * (uniform - 0.5)))

    def entropy(self) -> Tensor:
        return (math.log(2 * math.pi) + torch.log(self.gap * (2 - self.gap))).sum(-1)


@marginal.register
def _(density: WrappedCauchy, index: int) -> WrappedCauchy:
    here = slice(index, index + 1)
    return WrappedCauchy(density.location[..., here], density.gap[..., here])


class WrappedCauchyHead(DensityHead):
    """One wrapped Cauchy density per angle."""

    bibtex = """@book{mardia2000directional, author={Mardia, K. V. and Jupp, P. E.},
title={Directional Statistics}, year={2000}}"""

    def __init__(self, target: Target, *, largest: Annotated[float, Field(gt=0, lt=1)] = 0.999) -> None:
        super().__init__()
        target.require("angle", by="wrapped_cauchy")
        self.angles = len(target.names)
        self.size = 3 * self.angles
        self.largest = largest

    def forward(self, raw: Tensor) -> WrappedCauchy:
        raw = require_finite(raw, self.size)
        cos, sin, spread = raw.unflatten(-1, (self.angles, 3)).unbind(-1)
        # the squares in atan2's gradient neither over- nor underflow; 1 - length is not a difference
        mean = torch.atan2(sin.clamp(-1e18, 1e18), cos.clamp(-1e18, 1e18) + 1e-12)
        gap = (1 - self.largest) + self.largest * torch.sigmoid(-spread)
        return WrappedCauchy(mean, gap)

    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        return -self(raw).log_prob(target)

    def calibrate(self, raw: Tensor, target: Tensor) -> None:
        pass
