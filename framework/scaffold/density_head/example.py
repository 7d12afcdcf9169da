"""Laplace densities of real numbers."""

import math
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.nn.functional import softplus

from framework.density_head import DensityHead
from framework.distributions.protocol import estimate, exact_estimate, marginal
from framework.distributions.symmetric import Symmetric
from framework.heads.parameters import require_finite
from framework.target import Target

LARGEST = 1e18
"""Largest size of a raw parameter, so that no density overflows in float32."""


class Laplace(Symmetric):
    """Independent Laplace densities over the last dimension, exp(-|y - μ| / b) / (2 b).

    The base class returns `location` as mean, mode and median.

    Args:
        location: μ, (*batch, number).
        scale: b > 0, (*batch, number).
    """

    def __init__(
        self, location: Float[Tensor, "*batch number"], scale: Float[Tensor, "*batch number"]
    ) -> None:
        super().__init__(location)
        self.scale = scale

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density, nats."""
        size = (value - self.location).abs() / self.scale
        return -(size + self.scale.log() + math.log(2)).sum(-1)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        """Return draws: the size of the deviation is exponential, and its sign is random."""
        with torch.no_grad():
            location = self.location.expand(*sample_shape, *self.location.shape)
            size = self.scale * torch.empty_like(location).exponential_()
            return torch.where(torch.rand_like(location) < 0.5, location - size, location + size)

    def entropy(self) -> Tensor:
        """Return the entropy, nats."""
        return (1 + math.log(2) + self.scale.log()).sum(-1)

    @property
    def variance(self) -> Tensor:
        """Variance of each number, (*batch, number)."""
        return 2 * self.scale.square()


# framework.distributions.protocol lists everything that a density can register; the rest has defaults


@marginal.register
def _(density: Laplace, index: int) -> Laplace:
    kept = slice(index, index + 1)
    return Laplace(density.location[..., kept], density.scale[..., kept])


estimate.register(Laplace, exact_estimate)


class Example(DensityHead):
    """Independent Laplace densities of real numbers.

    The raw parameters of each number are its location and r; the scale is `smallest` + log(1 + exp r).

    Args:
        target: real numbers.
        smallest: smallest scale, in the unit of the target.

    Raises:
        ConfigError: the target is not real-valued.
    """

    bibtex = ""

    def __init__(
        self, target: Target, *, smallest: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1e-3
    ) -> None:
        super().__init__()
        target.require("real", by="example")
        self.numbers = len(target.names)
        self.size = 2 * self.numbers
        self.smallest = smallest

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Laplace:
        """Return the densities.

        Raises:
            ValueError: a raw parameter is not finite.
        """
        raw = require_finite(raw, self.size).clamp(-LARGEST, LARGEST)
        location, spread = raw.split(self.numbers, -1)
        return Laplace(location, self.smallest + softplus(spread))
