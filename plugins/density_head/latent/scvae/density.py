"""The densities of a simplified CVAE: a mixture of S samples, or of as many as a target error asks for."""

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.distributions.density import marginal, median
from framework.distributions.monte_carlo import (
    Effort,
    Estimate,
    NormalPoints,
    SampledMixture,
    estimate,
    estimate_log_mean,
    rows_of,
)
from framework.distributions.tempering import tempered

CHUNK = 2**22
"""Most hidden activations held at once without gradient (16 MiB in float32)."""


@dataclass(frozen=True)
class Networks:
    """The decoder on one batch of inputs x.

    Attributes:
        raw: what it reads of each input, (*batch, size).
        decode: (raw, z), broadcast against each other → the component's raw numbers (*batch, number).
        component: raw numbers → p(φ|x,z).
        latent: dimensions of z.
        width: activations one decoded z holds in memory.
        dtype: of z.
    """

    raw: Tensor
    decode: Callable[[Tensor, Tensor], Tensor]
    component: Callable[[Tensor], Distribution]
    latent: int
    width: int
    dtype: torch.dtype

    @property
    def batch_shape(self) -> torch.Size:
        return self.raw.shape[:-1]

    def points(self, effort: Effort, kept: int = 0) -> NormalPoints:
        """z of every item."""
        items, device = self.batch_shape.numel(), self.raw.device
        return NormalPoints(items, effort.replicates, self.latent, dtype=self.dtype, device=device, kept=kept)

    def numbers(self, z: Tensor) -> Tensor:
        """The component's raw numbers at z (*batch, sample, latent); without gradient chunk by chunk."""
        step = (
            z.shape[-2]
            if torch.is_grad_enabled()
            else max(1, self.at_once // max(1, self.batch_shape.numel()))
        )
        raw = self.raw.unsqueeze(-2)
        return torch.cat([self.decode(raw, part) for part in z.split(step, -2)], -2)

    @property
    def at_once(self) -> int:
        """How many z to decode together."""
        return CHUNK // self.width


def sampled_mixture(networks: Networks, points: NormalPoints, effort: Effort) -> SampledMixture:
    """A component at each of S points, with equal weights (eq. 3.21)."""
    items = torch.arange(networks.batch_shape.numel(), device=networks.raw.device)
    z = points(items, 0, effort.first)  # (replicate, count, item, latent)
    z = z.flatten(0, 1).movedim(0, 1).reshape(*networks.batch_shape, effort.samples, networks.latent)
    number = networks.numbers(z)
    weights = torch.zeros(number.shape[:-1], dtype=number.dtype, device=number.device)
    return SampledMixture(weights, networks.component(number), effort.replicates)


class SCVAEDensity(Distribution):
    """p(φ|x) = ∫ p(φ|x,z) N(z; 0, I) dz (eq. 3.21), with as many samples as its log-density's error asks for.

    `log_prob` doubles the samples of each value until the estimated error is below the tolerance; the points are drawn
    once, so that it is a function of φ. `sample` draws a fresh z for every value. `entropy`, `mode`, `median` and
    `marginal` are of `mixture`.
    """

    arg_constraints = {}  # noqa: RUF012  # pyright: ignore[reportAssignmentType]
    has_rsample = False

    def __init__(self, networks: Networks, effort: Effort) -> None:
        self.networks = networks
        self.effort = effort
        # drawn now, so that nothing depends on what is asked first
        self.points = networks.points(effort, kept=effort.first)
        self._fixed = Effort(effort.samples)
        self._mixture_points = networks.points(self._fixed)
        zero = torch.zeros(
            *networks.batch_shape, networks.latent, dtype=networks.dtype, device=networks.raw.device
        )
        self._example = networks.component(networks.decode(networks.raw, zero))
        self.has_enumerate_support = self._example.has_enumerate_support
        super().__init__(self._example.batch_shape, self._example.event_shape, validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        return self._example.support  # pyright: ignore[reportReturnType]

    def enumerate_support(self, expand: bool = True) -> Tensor:
        """Every class, (class, *batch) or (class, *1) without `expand`."""
        return self._example.enumerate_support(expand)

    @cached_property
    def mixture(self) -> SampledMixture:
        """A component at each of `samples` points: decoded on first use, then kept."""
        return sampled_mixture(self.networks, self._mixture_points, self._fixed)

    def log_prob(self, value: Tensor) -> Tensor:
        return estimate(self, value).log_mean

    @torch.no_grad()
    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape)
        networks = self.networks
        z = torch.randn(
            *self.batch_shape,
            shape.numel(),
            networks.latent,
            dtype=networks.dtype,
            device=networks.raw.device,
        )
        if z.numel() == 0:
            return self._example.sample(shape)
        drawn = networks.component(networks.numbers(z)).sample().movedim(len(self.batch_shape), 0)
        return drawn.reshape(shape + self.batch_shape + self.event_shape)

    @property
    def mode(self) -> Tensor:
        return self.mixture.mode

    def entropy(self) -> Tensor:
        return self.mixture.entropy()


@estimate.register
def _(density: SCVAEDensity, value: Tensor) -> Estimate:
    values, items, shape = rows_of(value, density.batch_shape, density.event_shape)
    networks = density.networks
    raw = networks.raw.reshape(-1, networks.raw.shape[-1])

    def log_weights(rows: Tensor, start: int, count: int) -> Tensor:
        z = density.points(items[rows], start, count)
        return networks.component(networks.decode(raw[items[rows]], z)).log_prob(values[rows])

    found = estimate_log_mean(
        log_weights, len(items), density.effort, at_once=networks.at_once, device=raw.device
    )
    return found.reshape(shape)


@marginal.register
def _(density: SCVAEDensity, index: int) -> Distribution:
    return marginal(density.mixture, index)


@median.register
def _(density: SCVAEDensity, samples: int) -> Tensor:
    return median(density.mixture, samples)


@tempered.register
def _(density: SCVAEDensity, temperature: Tensor) -> SCVAEDensity:
    """Component by component, at the same points z."""
    changed = copy.copy(density)
    changed.__dict__.pop("mixture", None)  # that of the untempered components, where it was asked for
    component = density.networks.component
    changed.networks = replace(density.networks, component=lambda raw: tempered(component(raw), temperature))
    changed._example = tempered(density._example, temperature)
    if temperature.requires_grad:
        changed.effort = density._fixed  # what a tolerance draws in rounds would all be held
    return changed
