"""The density of a latent-variable head, p(φ|x) = ∫ p(φ|x,z) p(z|x) dz, estimated by samples of the latent vector z.

φ is the target and x the input.
"""

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.distributions.description import PlainDensity
from framework.distributions.exported import Exported, exported
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
    stretch,
)

CHUNK = 2**22
"""Largest number of hidden activations in memory at once, if no gradient is needed (16 MiB in float32)."""
MODERATE = {"name": "von_mises", "floor": 1.0}
"""Settings of the default component, which cannot become uniform.

Several components together can describe a uniform density, and each still learns a direction.
"""


class Latent(ABC):
    """Base class of the networks of a latent-variable head, applied to one batch of inputs x.

    The networks give the latent vector z as a function of a standard normal vector, the noise, and for each z a
    component p(φ|x,z), the density of the target φ. An item is one element of the flattened batch.

    Attributes:
        component: function from raw parameters (*batch, number) to p(φ|x,z).
        center: z of the prior at noise 0, (*batch, latent).
        width: number of activations that one decoded z holds in memory.
        size: number of raw parameters that the component reads.
    """

    component: Callable[[Tensor], Distribution]
    center: Tensor
    width: int
    size: int

    def example(self) -> Distribution:
        """Return the components for raw parameters of 0, batch_shape (*batch).

        They have the same support as all other components, and no decoder is run for them.
        """
        return self.component(self.center.new_zeros(*self.center.shape[:-1], self.size))

    @abstractmethod
    def numbers(self, noise: Float[Tensor, "sample item latent"]) -> Float[Tensor, "*batch sample number"]:
        """Return the component's raw parameters at the z that belong to `noise`.

        The parameters are computed in chunks if no gradient is needed.
        """

    @abstractmethod
    def log_weights(
        self, value: Tensor, items: Int[Tensor, "row"], noise: Float[Tensor, "*draw row latent"]
    ) -> Float[Tensor, "*draw row"]:
        """Return the log of importance weights, nats; their expectation over the noise is p(φ|x) for φ in `value`.

        Args:
            value: (row, *event).
            items: index of each row's item in the flattened batch.
            noise: standard normal points.
        """

    @abstractmethod
    def sample(self, count: int) -> Tensor:
        """Return `count` samples of the target φ for each item, (count, *batch, *event), each with a new z."""

    @abstractmethod
    def tempered(self, temperature: Tensor) -> "Latent":
        """Return a copy with each component p replaced by p^(1/T), normalised, where T > 0 is `temperature`."""

    @property
    def items(self) -> int:
        """Number of items of the flattened batch."""
        return math.prod(self.center.shape[:-1])

    def full_precision(self) -> AbstractContextManager[Any]:
        """Return a context without autocast, so that networks are computed in full precision also in mixed training."""
        if torch.compiler.is_exporting():  # without autocast already
            return nullcontext()
        return torch.autocast(self.center.device.type, enabled=False)

    def points(self, effort: Effort, kept_count: int = 0) -> NormalPoints:
        """Return the sequences of standard normal points for all items (`NormalPoints`).

        Args:
            effort: number of samples, which determines the number of replicates (independent parts of the samples).
            kept_count: number of points at the start of each replicate that stay in memory after their first use.
        """
        dtype, device = self.center.dtype, self.center.device
        dimensions = self.center.shape[-1]
        return NormalPoints(
            self.items, effort.replicates, dimensions, dtype=dtype, device=device, kept_count=kept_count
        )

    def at_once(self, count: int) -> int:
        """Return how many of `count` samples z of an item are decoded together; all of them if a gradient is needed."""
        if torch.is_grad_enabled() or torch.compiler.is_exporting():
            return max(1, count)
        return max(1, CHUNK // (max(1, self.items) * self.width))


def sampled_mixture(latent: Latent, points: NormalPoints, effort: Effort) -> SampledMixture:
    """Return the mixture, with equal weights, of the components at S points z (thesis eq. 3.21).

    Args:
        latent: networks of the head, applied to a batch of inputs x.
        points: sequences of standard normal points, of which the first ones are used.
        effort: number S of points, and number of replicates (independent parts of the points).
    """
    items = torch.arange(latent.items, device=latent.center.device)
    number = latent.numbers(points(items, 0, effort.first).flatten(0, 1))
    weights = torch.zeros(number.shape[:-1], dtype=number.dtype, device=number.device)
    return SampledMixture(weights, latent.component(number), effort.replicates)


class LatentDensity(PlainDensity):
    """The density p(φ|x) = ∫ p(φ|x,z) p(z|x) dz (thesis eq. 3.12, 3.21).

    `log_prob` is the logarithm of the mean of importance weights at random values of z. These values are sampled once,
    so that log_prob is a fixed function of φ. Its expectation over the values of z is below the true log-density and
    rises towards it with their number. With a tolerance, the number of values of z is doubled for each φ until the
    estimated error is below the tolerance. `sample` draws a new z for every value. `entropy`, `mode`, `median` and
    `marginal` are computed from `mixture`.

    Args:
        latent: networks of the head, applied to a batch of inputs x.
        effort: number of values of z, and the tolerance.
    """

    def __init__(self, latent: Latent, effort: Effort) -> None:
        self.latent = latent
        self.effort = effort
        # sampled here, so that no result depends on the order of calls
        self.points = latent.points(effort, kept_count=effort.first)
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
        """Return every class, (class, *batch) if `expand` is true, or else (class, 1, …), which broadcasts to it."""
        return self._example.enumerate_support(expand)

    @cached_property
    def mixture(self) -> SampledMixture:
        """The mixture, with equal weights, of S components at z from the prior; computed once, at first use."""
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
            samples = self.latent.sample(shape.numel())
        return samples.reshape(shape + self.batch_shape + self.event_shape)

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
        noise, log_share = stretch(noise)
        weights = latent.log_weights(values[rows], items[rows], noise)
        return torch.stack([weights + log_share, log_share.expand_as(weights)])

    at_once = CHUNK // latent.width
    with latent.full_precision():
        result = estimate_log_mean(
            log_weights, len(items), density.effort, at_once=at_once, device=latent.center.device
        )
    return result.map_fields(lambda field: field.reshape(shape))


def _register_mixture(function: Any) -> None:
    """Register a function of the protocol for `LatentDensity`: apply it to the mixture of the sampled components."""

    @function.register
    def _(density: LatentDensity, *arguments: Any) -> Any:
        return function(density.mixture, *arguments)


for _function in (marginal, median, mode_candidates, peak_widths):
    _register_mixture(_function)


@uniform.register
def _(density: LatentDensity) -> Distribution:
    return uniform(density._example)


@exported.register
def _(density: LatentDensity) -> Exported:
    """Return the mixture of the sampled components; an exported model computes log-densities from this mixture."""
    remark = (
        f"Log-densities are those of a mixture of {density.effort.samples} components at random latent vectors from "
        "the prior; the original model estimates them by importance sampling or to a tolerance."
    )
    return replace(exported(density.mixture), remark=remark)


@tempered_density.register
def _(density: LatentDensity, temperature: Tensor) -> Distribution:
    """Return the tempered density.

    For angles and real numbers its components are tempered, at the same points z. For classes the whole density is
    tempered.
    """
    changed = copy.copy(density)
    if temperature.requires_grad:
        changed.effort = density._fixed  # with a tolerance, the samples of all rounds would stay in memory
    if density.has_enumerate_support:
        return tempered_classes(changed, temperature)
    changed.__dict__.pop("mixture", None)  # the cached mixture is that of the untempered components
    changed.latent = density.latent.tempered(temperature)
    changed._example = tempered_density(density._example, temperature)
    return changed
