"""The density of a latent-variable head, ∫ p(φ|x,z) p(z|x) dz, with as many samples as its tolerance requires."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.distributions.description import one_line
from framework.distributions.protocol import (
    Estimate,
    estimate,
    marginal,
    median,
    mode_candidates,
    peak_widths,
    tempered_density,
)
from framework.distributions.tempering import tempered_classes
from framework.distributions.uniform import uniform
from plugins.density_head.latent.monte_carlo import (
    Effort,
    NormalPoints,
    SampledMixture,
    estimate_log_mean,
    rows_of,
    stretched,
)

CHUNK = 2**22
"""Largest number of hidden activations held at once without gradient (16 MiB in float32)."""
MODERATE = {"name": "von_mises", "floor": 1.0}
"""Settings of a component that cannot become uniform alone: several together can, and each still learns a direction."""


class Latent(ABC):
    """p(φ|x,z) and z for one batch of inputs x; a standard normal vector, the noise, determines z.

    Attributes:
        component: raw parameters (*batch, number) → p(φ|x,z).
        center: z of the prior at noise 0, (*batch, latent).
        width: number of activations that one decoded z holds in memory.
        size: number of raw parameters that the component reads.
    """

    component: Callable[[Tensor], Distribution]
    center: Tensor
    width: int
    size: int

    def example(self) -> Distribution:
        """Return the component of raw parameters 0, (*batch); it shows the support without the cost of a decoder."""
        return self.component(self.center.new_zeros(*self.center.shape[:-1], self.size))

    @abstractmethod
    def numbers(self, noise: Float[Tensor, "sample item latent"]) -> Float[Tensor, "*batch sample number"]:
        """Return the component's raw parameters at z of the prior; without gradient chunk by chunk."""

    @abstractmethod
    def log_weights(
        self, value: Tensor, items: Int[Tensor, "row"], noise: Float[Tensor, "*draw row latent"]
    ) -> Float[Tensor, "*draw row"]:
        """Return the log of weights whose mean is p(φ|x), nats.

        Args:
            value: (row, *event).
            items: index of each row's item in the flattened batch.
            noise: standard normal points.
        """

    @abstractmethod
    def sample(self, count: int) -> Tensor:
        """Return `count` values of each item, (count, *batch, *event), each with a new z."""

    @abstractmethod
    def tempered(self, temperature: Tensor) -> "Latent":
        """Return a copy with tempered components."""

    @property
    def items(self) -> int:
        """Number of items of the flattened batch."""
        return self.center.shape[:-1].numel()

    def full_precision(self) -> torch.autocast:
        """Return the context in which networks are not rounded, whatever the precision that training chose."""
        return torch.autocast(self.center.device.type, enabled=False)

    def points(self, effort: Effort, kept: int = 0) -> NormalPoints:
        """Return the noise of every item."""
        dtype, device = self.center.dtype, self.center.device
        dimensions = self.center.shape[-1]
        return NormalPoints(self.items, effort.replicates, dimensions, dtype=dtype, device=device, kept=kept)

    def at_once(self, count: int) -> int:
        """Return how many of `count` z of every item are decoded together; with gradient all of them."""
        if torch.is_grad_enabled():
            return max(1, count)
        return max(1, CHUNK // (max(1, self.items) * self.width))


def sampled_mixture(latent: Latent, points: NormalPoints, effort: Effort) -> SampledMixture:
    """Return a mixture of a component at each of S points, with equal weights (eq. 3.21)."""
    items = torch.arange(latent.items, device=latent.center.device)
    number = latent.numbers(points(items, 0, effort.first).flatten(0, 1))
    weights = torch.zeros(number.shape[:-1], dtype=number.dtype, device=number.device)
    return SampledMixture(weights, latent.component(number), effort.replicates)


class LatentDensity(Distribution):
    """The density p(φ|x) = ∫ p(φ|x,z) p(z|x) dz (eq. 3.12, 3.21).

    `log_prob` is the log of a mean weight at points z that are drawn once, so that it is a function of φ. Its
    expectation over the draw is below the truth and rises to it with the number of samples. With a tolerance it doubles
    the samples of each value until the estimated error is below the tolerance. `sample` draws a new z for every value.
    `entropy`, `mode`, `median` and `marginal` are those of `mixture`.
    """

    arg_constraints = {}  # noqa: RUF012  # pyright: ignore[reportAssignmentType]
    has_rsample = False
    __repr__ = one_line

    def __init__(self, latent: Latent, effort: Effort) -> None:
        self.latent = latent
        self.effort = effort
        # drawn now, so that no result depends on the order of calls
        self.points = latent.points(effort, kept=effort.first)
        self._fixed = Effort(effort.samples)
        self._mixture_points = latent.points(self._fixed)
        self._example = latent.example()
        self.has_enumerate_support = self._example.has_enumerate_support
        super().__init__(self._example.batch_shape, self._example.event_shape, validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        """Support of the density."""
        return self._example.support  # pyright: ignore[reportReturnType]

    def enumerate_support(self, expand: bool = True) -> Tensor:
        """Return every class, (class, *batch) or (class, *1) without `expand`."""
        return self._example.enumerate_support(expand)

    @cached_property
    def mixture(self) -> SampledMixture:
        """The mixture of S components with equal weights and z from the prior: decoded at first use, then kept."""
        with self.latent.full_precision():
            return sampled_mixture(self.latent, self._mixture_points, self._fixed)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density, nats, (*sample, *batch)."""
        return estimate(self, value).log_mean

    @torch.no_grad()
    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        """Return samples, (*sample, *batch, *event)."""
        shape = torch.Size(sample_shape)
        if shape.numel() == 0 or self.batch_shape.numel() == 0:
            return self._example.sample(shape)
        with self.latent.full_precision():
            drawn = self.latent.sample(shape.numel())
        return drawn.reshape(shape + self.batch_shape + self.event_shape)

    @property
    def mode(self) -> Tensor:
        """Value of highest density of `mixture`."""
        return self.mixture.mode

    def entropy(self) -> Tensor:
        """Return the entropy of `mixture`, nats, (*batch)."""
        return self.mixture.entropy()


@estimate.register
def _(density: LatentDensity, value: Tensor) -> Estimate:
    values, items, shape = rows_of(value, density.batch_shape, density.event_shape)
    latent = density.latent

    def log_weights(rows: Tensor, start: int, count: int) -> Tensor:
        noise = density.points(items[rows], start, count)
        if not density.effort.tolerance:
            return latent.log_weights(values[rows], items[rows], noise)
        noise, log_share = stretched(noise)
        found = latent.log_weights(values[rows], items[rows], noise)
        return torch.stack([found + log_share, log_share.expand_as(found)])

    at_once = CHUNK // latent.width
    with latent.full_precision():
        found = estimate_log_mean(
            log_weights, len(items), density.effort, at_once=at_once, device=latent.center.device
        )
    return found.map_fields(lambda field: field.reshape(shape))


@marginal.register
def _(density: LatentDensity, index: int) -> Distribution:
    return marginal(density.mixture, index)


@uniform.register
def _(density: LatentDensity) -> Distribution:
    return uniform(density._example)


@median.register
def _(density: LatentDensity, samples: int) -> Tensor:
    return median(density.mixture, samples)


@mode_candidates.register
def _(density: LatentDensity) -> Tensor:
    return mode_candidates(density.mixture)


@peak_widths.register
def _(density: LatentDensity) -> Tensor:
    return peak_widths(density.mixture)


@tempered_density.register
def _(density: LatentDensity, temperature: Tensor) -> Distribution:
    """Return the density with tempered components at the same points; for classes the whole density is tempered."""
    changed = copy.copy(density)
    if temperature.requires_grad:
        changed.effort = density._fixed  # with a tolerance, the draws of all rounds would be held
    if density.has_enumerate_support:
        return tempered_classes(changed, temperature)
    changed.__dict__.pop("mixture", None)  # the cached mixture is that of the untempered components
    changed.latent = density.latent.tempered(temperature)
    changed._example = tempered_density(density._example, temperature)
    return changed
