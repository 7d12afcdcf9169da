"""The density of a conditional variational autoencoder, and its two bounds as functions."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.density import Mixture, marginal, median

CHUNK = 2**22
"""Most hidden activations held at once without gradient (16 MiB in float32)."""


@dataclass(frozen=True)
class Gaussian:
    """A diagonal Gaussian over z: mean and log standard deviation, (*batch, latent)."""

    mean: Tensor
    log_scale: Tensor

    def draw(self, count: int) -> Tensor:
        """z of shape (count, *batch, latent), differentiable in the parameters."""
        noise = torch.randn(count, *self.mean.shape, dtype=self.mean.dtype, device=self.mean.device)
        return self.mean + self.log_scale.exp() * noise

    def log_prob(self, z: Tensor) -> Tensor:
        standard = (z - self.mean) * torch.exp(-self.log_scale)
        return -(standard.square() / 2 + self.log_scale + math.log(2 * math.pi) / 2).sum(-1)


def kl_divergence(first: Gaussian, second: Gaussian) -> Tensor:
    """KL(first || second), nats, (*batch,), exactly 0 of equals (Kingma & Welling 2014, appendix B)."""
    log_ratio = 2 * (first.log_scale - second.log_scale)
    shift = (first.mean - second.mean) * torch.exp(-second.log_scale)
    return ((torch.expm1(log_ratio) - log_ratio + shift.square()) / 2).sum(-1)


def log_mean_exp(log_weight: Tensor, dim: int) -> Tensor:
    """log of the mean of exp; of one number, that number to the last bit."""
    return torch.logsumexp(log_weight, dim) - math.log(log_weight.shape[dim])


@dataclass(frozen=True)
class Networks:
    """The networks of one batch of inputs x.

    Attributes:
        prior: p(z|x), of shape (*batch, latent).
        posterior: φ of shape (*sample, *batch, *event) → q(z|x,φ) of shape (*sample, *batch, latent).
        decode: z of shape (*sample, *batch, latent) → the component's raw numbers (*sample, *batch, number).
        component: raw numbers → p(φ|x,z).
        width: activations one decoded z holds in memory.
    """

    prior: Gaussian
    posterior: Callable[[Tensor], Gaussian]
    decode: Callable[[Tensor], Tensor]
    component: Callable[[Tensor], Distribution]
    width: int


def importance_log_weights(networks: Networks, value: Tensor, samples: int) -> Tensor:
    """log p(φ|x,z) p(z|x) / q(z|x,φ) at z ~ q, (samples, *sample, *batch), nats (terms of eq. 3.19)."""
    posterior = networks.posterior(value)
    z = posterior.draw(samples)
    likelihood = networks.component(networks.decode(z)).log_prob(value)
    return likelihood + networks.prior.log_prob(z) - posterior.log_prob(z)


def evidence_bound(networks: Networks, value: Tensor, samples: int) -> Tensor:
    """Lower bound on log p(φ|x), nats: the first term by `samples` draws, the second exactly (eq. 3.17)."""
    posterior = networks.posterior(value)
    likelihood = networks.component(networks.decode(posterior.draw(samples))).log_prob(value)
    return likelihood.mean(0) - kl_divergence(posterior, networks.prior)


class CVAEDensity(Distribution):
    """p(φ|x) = ∫ p(φ|x,z) p(z|x) dz (eq. 3.12).

    `log_prob` is the importance-weighted bound (eq. 3.19) with `samples` proposals z ~ q(z|x,φ) for every
    value: it is random, in expectation below the truth, and rises to it with `samples`. `sample` draws a
    fresh z from the prior for every value. `entropy`, `mode`, `median` and `marginal` are of `mixture`.
    """

    arg_constraints = {}  # noqa: RUF012  # pyright: ignore[reportAssignmentType]
    has_rsample = False

    def __init__(self, networks: Networks, samples: int) -> None:
        self.networks = networks
        self.samples = samples
        self._example = networks.component(networks.decode(networks.prior.mean))
        super().__init__(self._example.batch_shape, self._example.event_shape, validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        return self._example.support  # pyright: ignore[reportReturnType]

    @cached_property
    def mixture(self) -> Mixture:
        """Equal weights on `samples` components with z from the prior: drawn on first use, then kept."""
        z = self.networks.prior.draw(self.samples)
        parts = [self.networks.decode(part) for part in z.split(self._at_once(self.samples, 1))]
        number = torch.cat(parts).movedim(0, -2)
        weights = torch.zeros(number.shape[:-1], dtype=number.dtype, device=number.device)
        return Mixture(weights, self.networks.component(number))

    def log_prob(self, value: Tensor) -> Tensor:
        event = len(self.event_shape)
        shape = torch.Size(torch.broadcast_shapes(value.shape[: value.dim() - event], self.batch_shape))
        lead = shape[: len(shape) - len(self.batch_shape)]
        rows = value.expand(shape + self.event_shape).reshape(
            (lead.numel(), *self.batch_shape, *self.event_shape)
        )
        draws = self._at_once(self.samples, 1)
        step = self._at_once(len(rows), self.samples)
        found = []
        for part in rows.split(step):
            weights = [
                importance_log_weights(self.networks, part, min(draws, self.samples - done))
                for done in range(0, self.samples, draws)
            ]
            found.append(log_mean_exp(torch.cat(weights), 0))
        return torch.cat(found).reshape(shape)

    @torch.no_grad()
    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape)
        count = shape.numel()
        step = self._at_once(count, 1)
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

    def _at_once(self, count: int, each: int) -> int:
        """How many of `count` to decode together, each with `each` z per item; under gradient all of them."""
        if torch.is_grad_enabled():
            return max(1, count)
        return max(1, CHUNK // (max(1, self.batch_shape.numel()) * each * self.networks.width))


@marginal.register
def _(density: CVAEDensity, index: int) -> Distribution:
    return marginal(density.mixture, index)


@median.register
def _(density: CVAEDensity, samples: int) -> Tensor:
    return median(density.mixture, samples)
