"""Independent Bernoulli densities of the numbers of an image."""

from collections.abc import Collection

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution, constraints
from torch.nn.functional import logsigmoid

from framework.distributions.description import PlainDensity
from framework.distributions.exported import Exported, exported
from framework.distributions.protocol import (
    estimate,
    exact_estimate,
    images,
    marginal_cdfs,
    median,
    pick,
    take,
    tempered_density,
)
from framework.geometry.srgb import linear_from_srgb


class BernoulliImage(PlainDensity):
    """Independent Bernoulli densities of the numbers of an image: each is 1 with its own probability, and 0 otherwise.

    A number is the value of one channel of one pixel. For the value y and the log-odds r of a number, log p = y log
    σ(r) + (1 - y) log σ(-r) with the logistic function σ. A value y between 0 and 1 is read as the share of the pixel
    that is 1; log p is then the mean over the area of the pixel. Values outside [0, 1] are clamped.

    Args:
        logits: r, (*batch, height, width, number), log-odds of 1.
    """

    def __init__(self, logits: Float[Tensor, "*batch height width number"]) -> None:
        self.logits = logits
        super().__init__(logits.shape[:-3], logits.shape[-3:], validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        """Support of the density."""
        return constraints.independent(constraints.boolean, 3)

    @property
    def mean(self) -> Tensor:
        """Probability of each number to be 1, (*batch, height, width, number)."""
        return self.logits.sigmoid()

    @property
    def mode(self) -> Tensor:
        """Most likely image: each number is 1 if 1 is at least as likely as 0, and 0 otherwise."""
        return (self.logits >= 0).to(self.logits)

    @property
    def variance(self) -> Tensor:
        """Variance of each number."""
        return self.logits.sigmoid() * (-self.logits).sigmoid()

    def each_log_prob(self, value: Tensor) -> Tensor:
        """Return the log-probability of every single number, nats, shaped like `value`."""
        share = value.clamp(0, 1)
        return share * logsigmoid(self.logits) + (1 - share) * logsigmoid(-self.logits)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-probability, nats, (*sample, *batch)."""
        return self.each_log_prob(value).sum((-3, -2, -1))

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        """Return samples, (*sample, *batch, *event)."""
        with torch.no_grad():
            return self.mean.expand(torch.Size(sample_shape) + self.logits.shape).bernoulli()

    def entropy(self) -> Tensor:
        """Return the entropy, nats, (*batch)."""
        # -p log p - q log q = log(1 + e^-|r|) + |r| / (1 + e^|r|)
        size = self.logits.abs()
        return (size * (-size).sigmoid() - logsigmoid(size)).sum((-3, -2, -1))


estimate.register(BernoulliImage, exact_estimate)


@median.register
def _(density: BernoulliImage, samples: int) -> Tensor:
    return density.mode


@marginal_cdfs.register
def _(density: BernoulliImage, value: Tensor) -> Tensor:
    below = (-density.logits.double()).sigmoid()
    return torch.where(value < 0, 0.0, torch.where(value < 1, below, 1.0))


@pick.register
def _(density: BernoulliImage, index: Tensor) -> BernoulliImage:
    return BernoulliImage(take(density.logits.flatten(-3), index).unflatten(-1, density.event_shape))


@tempered_density.register
def _(density: BernoulliImage, temperature: Tensor) -> BernoulliImage:
    # odds^(1/T)
    return BernoulliImage(density.logits / temperature)


@images.register
def _(density: BernoulliImage, channels: Collection[str]) -> dict[str, Tensor]:
    """Return the requested channels of the images.

    "color" holds the probabilities, read as sRGB and converted to linear RGB. "mask" is true where 1 is at least as
    likely as 0.
    """
    if (
        not channels
        or not set(channels) <= {"color", "mask"}
        or ("mask" in channels and density.event_shape[-1] > 1)
    ):
        return images.dispatch(Distribution)(density, channels)
    compute = {"color": lambda: linear_from_srgb(density.mean), "mask": lambda: density.logits[..., 0] >= 0}
    return {name: compute[name]() for name in channels}


@exported.register
def _(density: BernoulliImage) -> Exported:
    code = "plugins.density_head.bernoulli_image.numpy_bernoulli_image"
    return Exported("bernoulli_image", {"logits": density.logits}, code=code)
