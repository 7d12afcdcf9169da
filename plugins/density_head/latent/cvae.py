"""Conditional variational autoencoder: its networks, two lower bounds of its log-likelihood, and the density head."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.density_head import DensityHead
from framework.distributions.protocol import tempered_density
from framework.heads.parameters import require_finite
from framework.heads.unit import Unit
from framework.target import Target
from plugins.density_head.latent.decoder import LARGEST_FEATURE, LatentDecoder
from plugins.density_head.latent.density import MODERATE, Latent, LatentDensity
from plugins.density_head.latent.head import LatentHead, LatentSettings
from plugins.density_head.latent.monte_carlo import Effort

DEFAULT_SETTINGS = LatentSettings(latent=8, training_samples=10)

LARGEST_LOG_SCALE = 7.0
"""Bound on the log standard deviations of z, so that no ratio of two standard deviations overflows."""


@dataclass(frozen=True)
class Gaussian:
    """A diagonal Gaussian over z: mean and log standard deviation, (*batch, latent)."""

    mean: Tensor
    log_scale: Tensor

    def draw(self, count: int) -> Tensor:
        """Return `count` random samples z, (count, *batch, latent), differentiable in the Gaussian's parameters."""
        return self.at(torch.randn(count, *self.mean.shape, dtype=self.mean.dtype, device=self.mean.device))

    def at(self, noise: Tensor) -> Tensor:
        """Return z = mean + standard deviation · noise, for standard normal `noise` (*sample, *batch, latent)."""
        return self.mean + self.log_scale.exp() * noise

    def log_prob(self, z: Tensor) -> Tensor:
        """Return the log-density of z, nats, (*sample, *batch)."""
        return self.log_prob_at((z - self.mean) * torch.exp(-self.log_scale))

    def log_prob_at(self, noise: Tensor) -> Tensor:
        """Return `log_prob(at(noise))`, (*sample, *batch), nats, computed from the noise.

        The difference z - mean, which loses digits if the mean is large, is not computed.
        """
        return -(noise.square() / 2 + self.log_scale + math.log(2 * math.pi) / 2).sum(-1)


def kl_divergence(first: Gaussian, second: Gaussian) -> Tensor:
    """Return KL(first || second), nats, (*batch,); 0 for equal arguments (Kingma & Welling 2014, appendix B)."""
    log_ratio = 2 * (first.log_scale - second.log_scale)
    shift = (first.mean - second.mean) * torch.exp(-second.log_scale)
    return ((torch.expm1(log_ratio) - log_ratio + shift.square()) / 2).sum(-1)


@dataclass(frozen=True)
class Networks(Latent):
    """The networks of a CVAE, applied to one batch of inputs x.

    Attributes:
        prior: p(z|x), of shape (*batch, latent).
        posterior: function from φ (*sample, *batch, *event) to q(z|x,φ) of shape (*sample, *batch, latent).
        decode: function from z (*sample, *batch, latent) to the component's raw parameters (*sample, *batch, number).
        component: function from raw parameters to p(φ|x,z).
        rows: function from indices (rows,) of inputs in the flattened batch to the networks of these inputs alone.
        width: number of activations that one decoded z holds in memory.
        size: number of raw parameters that the component reads.
    """

    prior: Gaussian
    posterior: Callable[[Tensor], Gaussian]
    decode: Callable[[Tensor], Tensor]
    component: Callable[[Tensor], Distribution]
    rows: Callable[[Tensor], "Networks"]
    width: int
    size: int

    @property
    def center(self) -> Tensor:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Mean of the prior, (*batch, latent)."""
        return self.prior.mean

    def numbers(self, noise: Tensor) -> Tensor:
        """Return the component's raw parameters at z = prior mean + prior standard deviation · noise.

        The shape is (*batch, sample, number) for standard normal `noise`.
        """
        z = self.prior.at(noise.reshape(len(noise), *self.center.shape))
        return torch.cat([self.decode(part) for part in z.split(self.at_once(len(z)))]).movedim(0, -2)

    def log_weights(self, value: Tensor, items: Tensor, noise: Tensor) -> Tensor:
        """Return the log of the importance weights of z drawn from the encoder q(z|x,φ), nats (thesis eq. 3.19).

        `value` are targets φ, (row, *event), and `items` the index of each row's item in the flattened batch. `noise`
        holds the standard normal numbers from which z is computed, (*draw, row, latent).
        """
        return importance_log_weights(self.rows(items), value, noise)

    def sample(self, count: int) -> Tensor:
        """Return `count` samples of the target φ for each item, (count, *batch, *event), each with a new z."""
        step = self.at_once(count)
        parts = [
            self.component(self.decode(self.prior.draw(min(step, count - start)))).sample()
            for start in range(0, count, step)
        ]
        return torch.cat(parts)

    def tempered(self, temperature: Tensor) -> "Networks":
        """Return a copy with each component p replaced by p^(1/T), normalised, where T > 0 is `temperature`."""
        return replace(
            self,
            component=lambda raw: tempered_density(self.component(raw), temperature),
            rows=lambda index: self.rows(index).tempered(temperature),
        )


def importance_log_weights(networks: Networks, value: Tensor, noise: Tensor) -> Tensor:
    """Return log p(φ|x,z) p(z|x) / q(z|x,φ), nats, for φ in `value` and z drawn from q (thesis eq. 3.19).

    `noise` holds the standard normal numbers from which z is computed. The shapes are (*sample, *batch, *event) for
    `value`, (*draw, *sample, *batch, latent) for `noise`, and (*draw, *sample, *batch) for the result.
    """
    posterior = networks.posterior(value)
    z = posterior.at(noise)
    likelihood = networks.component(networks.decode(z)).log_prob(value)
    return likelihood + networks.prior.log_prob(z) - posterior.log_prob_at(noise)


def evidence_bound(networks: Networks, value: Tensor, samples: int) -> Tensor:
    """Return a lower bound on log p(φ|x) for φ in `value`, nats, (*batch,) (thesis eq. 3.17).

    It is the expectation of log p(φ|x,z) under q(z|x,φ), estimated by `samples` samples of z, minus the exact
    divergence of q(z|x,φ) from the prior.
    """
    posterior = networks.posterior(value)
    likelihood = networks.component(networks.decode(posterior.draw(samples))).log_prob(value)
    return likelihood.mean(0) - kl_divergence(posterior, networks.prior)


class CVAEHead(LatentHead):
    """CVAE: an infinite mixture over a latent z with a learned prior (thesis §3.5.2, eq. 3.12-3.20).

    x is the input, φ the target and z a latent vector. Three networks, the prior p(z|x), the encoder q(z|x,φ) and the
    decoder p(φ|x,z), are trained by the evidence lower bound (eq. 3.17-3.18); log_prob is the importance-weighted bound
    (eq. 3.19). The first layer of each network has a part that reads only the features of x. This part is the linear
    layer that the framework puts before the head, so it is computed once per input and not once per sample.

    Args:
        settings: size of each of the three networks, and number of samples of z. In evaluation, the samples serve the
            bound, and the mixture that gives mode and entropy.
        backbones: "shared": prior, encoder and decoder read the features of one network; "each": each of the three
            reads the features of its own network, of the same architecture (thesis §3.6.1).
        component: the head whose densities are mixed.
    """

    bibtex = "sohn2015learning, burda2016importance"

    def __init__(
        self,
        target: Target,
        *,
        settings: LatentSettings = DEFAULT_SETTINGS,
        backbones: Literal["shared", "each"] = "shared",
        component: DensityHead = MODERATE,  # pyright: ignore[reportArgumentType]  # built by the framework
    ) -> None:
        super().__init__(settings, component)
        latent, hidden = settings.latent, settings.hidden
        self.target = target
        self.unit = Unit.of(target)
        self.prior = _layers_after_first(hidden, 2 * latent)
        self.from_value = nn.Linear(
            len(target.names) * (2 if target.kind == "angle" else 1), hidden, bias=False
        )
        self.posterior = _layers_after_first(hidden, 2 * latent)
        self.decoder = LatentDecoder(latent, hidden, component.size)
        parts = (hidden, hidden, self.decoder.size)
        self.size = sum(parts)
        if backbones == "each":
            self.backbones = parts

    def forward(self, raw: Float[Tensor, "*batch size"]) -> LatentDensity:
        """Return the density for raw parameters."""
        effort = Effort(self.training_samples) if self.training else self.effort()
        return LatentDensity(self.networks(raw), effort)

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        """Return the negative evidence lower bound of each sample, nats (thesis eq. 3.18)."""
        return -evidence_bound(self.networks(raw), target, self.training_samples)

    def networks(self, raw: Float[Tensor, "*batch size"]) -> Networks:
        """Return the networks (prior, encoder and decoder) for the inputs whose raw parameters are `raw`."""
        raw = require_finite(raw, self.size)
        # clamped, so that nothing overflows in the layers that follow
        features = raw.to(self.from_value.weight.dtype).clamp(-LARGEST_FEATURE, LARGEST_FEATURE)
        return self._networks(features)

    def _networks(self, features: Float[Tensor, "*batch size"]) -> Networks:
        for_prior, for_posterior, for_decoder = features.split(
            [self.hidden, self.hidden, self.decoder.size], -1
        )
        flat = features.reshape(-1, self.size)
        return Networks(
            prior=_gaussian(self.prior(for_prior)),
            posterior=lambda value: _gaussian(
                self.posterior(for_posterior + self.from_value(self.encode(value).to(features.dtype)))
            ),
            decode=lambda z: self.decoder(for_decoder, z),
            component=self.component,
            rows=lambda index: self._networks(flat[index]),
            width=self.hidden,
            size=self.component.size,
        )

    def encode(self, value: Tensor) -> Tensor:
        """Return the encoder's input for a target: biternions of angles, one-hot labels, standardised reals."""
        if self.target.kind == "angle":
            return torch.cat([value.cos(), value.sin()], -1)
        if self.target.kind == "class":
            return nn.functional.one_hot(value, len(self.target.names))
        return self.unit.standardise(value)


def _layers_after_first(hidden: int, numbers: int) -> nn.Sequential:
    """Return the layers of a network after its first linear layer: `hidden` features in, `numbers` outputs."""
    return nn.Sequential(nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, numbers))


def _gaussian(number: Tensor) -> Gaussian:
    number = require_finite(number, number.shape[-1])  # half precision under autocast
    mean, log_scale = number.chunk(2, -1)
    return Gaussian(mean, LARGEST_LOG_SCALE * torch.tanh(log_scale / LARGEST_LOG_SCALE))
