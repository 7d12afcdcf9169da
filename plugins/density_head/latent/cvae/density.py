"""The density of a conditional variational autoencoder, and its two bounds as functions."""

import copy
import math
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
class Gaussian:
    """A diagonal Gaussian over z: mean and log standard deviation, (*batch, latent)."""

    mean: Tensor
    log_scale: Tensor

    def draw(self, count: int) -> Tensor:
        """z of shape (count, *batch, latent), differentiable in the parameters."""
        return self.at(torch.randn(count, *self.mean.shape, dtype=self.mean.dtype, device=self.mean.device))

    def at(self, noise: Tensor) -> Tensor:
        """z at standard normal numbers (*sample, *batch, latent)."""
        return self.mean + self.log_scale.exp() * noise

    def log_prob(self, z: Tensor) -> Tensor:
        return self.log_prob_at((z - self.mean) * torch.exp(-self.log_scale))

    def log_prob_at(self, noise: Tensor) -> Tensor:
        """log_prob of `at(noise)`, without the cancellation in z - mean where the mean is large."""
        return -(noise.square() / 2 + self.log_scale + math.log(2 * math.pi) / 2).sum(-1)


def kl_divergence(first: Gaussian, second: Gaussian) -> Tensor:
    """KL(first || second), nats, (*batch,), exactly 0 of equals (Kingma & Welling 2014, appendix B)."""
    log_ratio = 2 * (first.log_scale - second.log_scale)
    shift = (first.mean - second.mean) * torch.exp(-second.log_scale)
    return ((torch.expm1(log_ratio) - log_ratio + shift.square()) / 2).sum(-1)


@dataclass(frozen=True)
class Networks:
    """The networks of one batch of inputs x.

    Attributes:
        prior: p(z|x), of shape (*batch, latent).
        posterior: φ of shape (*sample, *batch, *event) → q(z|x,φ) of shape (*sample, *batch, latent).
        decode: z of shape (*sample, *batch, latent) → the component's raw numbers (*sample, *batch, number).
        component: raw numbers → p(φ|x,z).
        rows: indices (rows,) into the flattened batch → the networks of these inputs.
        width: activations one decoded z holds in memory.
    """

    prior: Gaussian
    posterior: Callable[[Tensor], Gaussian]
    decode: Callable[[Tensor], Tensor]
    component: Callable[[Tensor], Distribution]
    rows: Callable[[Tensor], "Networks"]
    width: int


def importance_log_weights(networks: Networks, value: Tensor, noise: Tensor) -> Tensor:
    """log p(φ|x,z) p(z|x) / q(z|x,φ), nats, of z ~ q at standard normal `noise` (terms of eq. 3.19).

    Shapes: value (*sample, *batch, *event), noise (*draw, *sample, *batch, latent), result (*draw, *sample, *batch).
    """
    posterior = networks.posterior(value)
    z = posterior.at(noise)
    likelihood = networks.component(networks.decode(z)).log_prob(value)
    return likelihood + networks.prior.log_prob(z) - posterior.log_prob_at(noise)


def evidence_bound(networks: Networks, value: Tensor, samples: int) -> Tensor:
    """Lower bound on log p(φ|x), nats: the first term by `samples` draws, the second exactly (eq. 3.17)."""
    posterior = networks.posterior(value)
    likelihood = networks.component(networks.decode(posterior.draw(samples))).log_prob(value)
    return likelihood.mean(0) - kl_divergence(posterior, networks.prior)


class CVAEDensity(Distribution):
    """p(φ|x) = ∫ p(φ|x,z) p(z|x) dz (eq. 3.12).

    `log_prob` is the importance-weighted bound (eq. 3.19), with z ~ q(z|x,φ) at points that are drawn once: a function
    of φ, with respect to the draw in expectation below the truth, rising to it with the samples. `sample` draws a
    fresh z from the prior for every value. `entropy`, `mode`, `median` and `marginal` are of `mixture`.
    """

    arg_constraints = {}  # noqa: RUF012  # pyright: ignore[reportAssignmentType]
    has_rsample = False

    def __init__(self, networks: Networks, effort: Effort) -> None:
        self.networks = networks
        self.effort = effort
        # drawn now, so that nothing depends on what is asked first
        self.noise = self._points(effort, kept=effort.first)
        self._fixed = Effort(effort.samples)
        self._mixture_noise = self._points(self._fixed)
        self._example = networks.component(networks.decode(networks.prior.mean))
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
        """Equal weights on S components with z from the prior: decoded on first use, then kept."""
        effort, items = self._fixed, self.batch_shape.numel()
        noise = self._mixture_noise(
            torch.arange(items, device=self.networks.prior.mean.device), 0, effort.first
        )
        z = self.networks.prior.at(noise.reshape(effort.samples, *self.networks.prior.mean.shape))
        parts = [self.networks.decode(part) for part in z.split(self._at_once(effort.samples))]
        number = torch.cat(parts).movedim(0, -2)
        weights = torch.zeros(number.shape[:-1], dtype=number.dtype, device=number.device)
        return SampledMixture(weights, self.networks.component(number), effort.replicates)

    def log_prob(self, value: Tensor) -> Tensor:
        return estimate(self, value).log_mean

    @torch.no_grad()
    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape)
        count = shape.numel()
        step = self._at_once(count)
        parts = [
            self.networks.component(
                self.networks.decode(self.networks.prior.draw(min(step, count - done)))
            ).sample()
            for done in range(0, count, step)
        ]
        if not parts:
            return self._example.sample(shape)
        return torch.cat(parts).reshape(shape + self.batch_shape + self.event_shape)

    @property
    def mode(self) -> Tensor:
        return self.mixture.mode

    def entropy(self) -> Tensor:
        return self.mixture.entropy()

    def _points(self, effort: Effort, kept: int = 0) -> NormalPoints:
        mean = self.networks.prior.mean
        items, latent = mean.shape[:-1].numel(), mean.shape[-1]
        return NormalPoints(items, effort.replicates, latent, dtype=mean.dtype, device=mean.device, kept=kept)

    def _at_once(self, count: int) -> int:
        """How many of `count` z of every item to decode together; under gradient all of them."""
        if torch.is_grad_enabled():
            return max(1, count)
        return max(1, CHUNK // (max(1, self.batch_shape.numel()) * self.networks.width))


@estimate.register
def _(density: CVAEDensity, value: Tensor) -> Estimate:
    values, items, shape = rows_of(value, density.batch_shape, density.event_shape)

    def log_weights(rows: Tensor, start: int, count: int) -> Tensor:
        noise = density.noise(items[rows], start, count)
        return importance_log_weights(density.networks.rows(items[rows]), values[rows], noise)

    at_once = CHUNK // density.networks.width
    found = estimate_log_mean(
        log_weights, len(items), density.effort, at_once=at_once, device=density.networks.prior.mean.device
    )
    return found.reshape(shape)


@marginal.register
def _(density: CVAEDensity, index: int) -> Distribution:
    return marginal(density.mixture, index)


@median.register
def _(density: CVAEDensity, samples: int) -> Tensor:
    return median(density.mixture, samples)


@tempered.register
def _(density: CVAEDensity, temperature: Tensor) -> CVAEDensity:
    """Component by component; prior, encoder and the drawn points stay."""
    changed = copy.copy(density)
    changed.__dict__.pop("mixture", None)  # that of the untempered components, where it was asked for
    changed.networks = _tempered(density.networks, temperature)
    changed._example = tempered(density._example, temperature)
    if temperature.requires_grad:
        changed.effort = density._fixed  # what a tolerance draws in rounds would all be held
    return changed


def _tempered(networks: Networks, temperature: Tensor) -> Networks:
    return replace(
        networks,
        component=lambda raw: tempered(networks.component(raw), temperature),
        rows=lambda index: _tempered(networks.rows(index), temperature),
    )
