"""Densities over images as densities over vectors, so that checks of vectors also apply to images."""

from typing import ClassVar

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.distributions.protocol import cdf, marginal_cdfs, median


def flatten(density: Distribution) -> Distribution:
    """Return a density over images as one over vectors; return any other density unchanged."""
    return Flattened(density) if len(density.event_shape) == 3 else density


class Flattened(Distribution):
    """Density over vectors of length height · width · number, from a density over images (height, width, number)."""

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    def __init__(self, density: Distribution) -> None:
        self.density = density
        numbers = torch.Size((density.event_shape.numel(),))
        super().__init__(density.batch_shape, numbers, validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        return constraints.real_vector

    def image(self, value: Tensor) -> Tensor:
        """Return vectors (..., height · width · number) as images (..., height, width, number)."""
        return value.unflatten(-1, self.density.event_shape)

    def log_prob(self, value: Tensor) -> Tensor:
        return self.density.log_prob(self.image(value))

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        return self.density.sample(torch.Size(sample_shape)).flatten(-3)

    @property
    def mode(self) -> Tensor:
        return self.density.mode.flatten(-3)

    @property
    def mean(self) -> Tensor:
        return self.density.mean.flatten(-3)

    @property
    def variance(self) -> Tensor:
        return self.density.variance.flatten(-3)

    def entropy(self) -> Tensor:
        return self.density.entropy()


@median.register
def _(density: Flattened, samples: int) -> Tensor:
    return median(density.density, samples).flatten(-3)


@cdf.register
def _(density: Flattened, value: Tensor) -> Tensor | None:
    """Return the distribution function of an image of a single number."""
    probability = marginal_cdfs(density.density, density.image(value))
    return None if probability is None else probability[..., 0, 0, 0]
