"""Independent Laplace densities of the numbers of an image."""

import math
from collections.abc import Collection

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.distributions.exported import Exported, exported
from framework.distributions.protocol import (
    estimate,
    exact_estimate,
    images,
    marginal_cdfs,
    pick,
    take,
    tempered_density,
)
from framework.distributions.symmetric import Symmetric
from framework.geometry.srgb import linear_from_srgb


class LaplaceImage(Symmetric):
    """Independent Laplace densities of the numbers of an image.

    A number is the value of one channel of one pixel. For a number with the value y, the location μ and the scale b,
    log p = -|y - μ|/b - log 2b. If b is the same for all numbers, the negative log-likelihood is the L1 distance
    between images, up to a factor and a constant.

    Args:
        location: μ, (*batch, height, width, number), in sRGB as image files hold it.
        scale: b > 0, broadcastable to `location`.
    """

    has_rsample = True

    def __init__(
        self, location: Float[Tensor, "*batch height width number"], scale: Float[Tensor, "*any"]
    ) -> None:
        super().__init__(location, event_dimensions=3)
        self.scale = scale.expand_as(location)

    @property
    def support(self) -> constraints.Constraint:
        """Support of the density."""
        return constraints.independent(constraints.real, 3)

    @property
    def variance(self) -> Tensor:
        """Variance of each number."""
        return 2 * self.scale.square()

    def each_log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density of every single number, nats, shaped like `value`."""
        return -((value - self.location).abs() / self.scale + (2 * self.scale).log())

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density, nats, (*sample, *batch)."""
        return self.each_log_prob(value).sum((-3, -2, -1))

    def rsample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        """Return samples, (*sample, *batch, *event), differentiable in the parameters."""
        shape = torch.Size(sample_shape) + self.location.shape
        # the difference of two exponential samples is a Laplace sample; no logarithm of a rounded 0 can occur
        exponentials = self.location.new_empty(2, *shape).exponential_()
        return self.location + self.scale * (exponentials[0] - exponentials[1])

    def entropy(self) -> Tensor:
        """Return the entropy, nats, (*batch)."""
        return (1 + math.log(2) + self.scale.log()).sum((-3, -2, -1))


estimate.register(LaplaceImage, exact_estimate)


@marginal_cdfs.register
def _(density: LaplaceImage, value: Tensor) -> Tensor:
    away = (value.double() - density.location.double()) / density.scale.double()
    tail = (-away.abs()).exp() / 2
    return torch.where(away < 0, tail, 1 - tail)


@pick.register
def _(density: LaplaceImage, index: Tensor) -> LaplaceImage:
    parts = (
        take(part.flatten(-3), index).unflatten(-1, density.event_shape)
        for part in (density.location, density.scale)
    )
    return LaplaceImage(*parts)


@tempered_density.register
def _(density: LaplaceImage, temperature: Tensor) -> LaplaceImage:
    # exp(-d/b)^(1/T) = exp(-d/bT)
    return LaplaceImage(density.location, density.scale * temperature)


@images.register
def _(density: LaplaceImage, channels: Collection[str]) -> dict[str, Tensor]:
    if set(channels) != {"color"}:
        return images.dispatch(Distribution)(density, channels)
    return {"color": linear_from_srgb(density.location)}


@exported.register
def _(density: LaplaceImage) -> Exported:
    code = "plugins.density_head.laplace_image.numpy_laplace_image"
    return Exported("laplace_image", {"location": density.location, "scale": density.scale}, code=code)
