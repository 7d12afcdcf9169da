"""The simplified conditional variational autoencoder: its decoder for one batch, and the density head."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution

from framework.density_head import DensityHead
from framework.distributions.density import Mixture
from framework.distributions.protocol import tempered_density
from framework.heads.parameters import require_finite
from framework.target import Target
from plugins.density_head.latent.decoder import LatentDecoder
from plugins.density_head.latent.density import MODERATE, Latent, LatentDensity, sampled_mixture
from plugins.density_head.latent.head import LatentHead, LatentSettings

DEFAULT_SETTINGS = LatentSettings(latent=2, training_samples=50)


@dataclass(frozen=True)
class Networks(Latent):
    """The decoder of an SCVAE, applied to one batch of inputs x; z is the noise itself.

    Attributes:
        raw: raw parameters of each input, (*batch, size).
        decode: function from (raw, z), which are broadcast, to the component's raw parameters (*batch, number).
        component: function from raw parameters to p(φ|x,z).
        center: zeros, (*batch, latent), of the dtype of z.
        width: number of activations that one decoded z holds in memory.
        size: number of raw parameters that the component reads.
    """

    raw: Tensor
    decode: Callable[[Tensor, Tensor], Tensor]
    component: Callable[[Tensor], Distribution]
    center: Tensor
    width: int
    size: int

    def numbers(self, noise: Tensor) -> Tensor:
        """Return the component's raw parameters at z = noise, (*batch, sample, number)."""
        return self._decoded(noise.movedim(0, 1).reshape(*self.raw.shape[:-1], len(noise), noise.shape[-1]))

    def _decoded(self, z: Float[Tensor, "*batch sample latent"]) -> Float[Tensor, "*batch sample number"]:
        raw = self.raw.unsqueeze(-2)
        return torch.cat([self.decode(raw, part) for part in z.split(self.at_once(z.shape[-2]), -2)], -2)

    def log_weights(self, value: Tensor, items: Tensor, noise: Tensor) -> Tensor:
        """Return the component's log-density at each z, nats (thesis eq. 3.21).

        `value` are targets φ, (row, *event), and `items` the index of each row's item in the flattened batch. `noise`
        holds the values of z, (*draw, row, latent).
        """
        raw = self.raw.reshape(-1, self.raw.shape[-1])[items]
        return self.component(self.decode(raw, noise)).log_prob(value)

    def sample(self, count: int) -> Tensor:
        """Return `count` samples of the target φ for each item, (count, *batch, *event), each with a new z."""
        like = self.center
        z = torch.randn(*like.shape[:-1], count, like.shape[-1], dtype=like.dtype, device=like.device)
        return self.component(self._decoded(z)).sample().movedim(like.dim() - 1, 0)

    def tempered(self, temperature: Tensor) -> "Networks":
        """Return a copy with each component p replaced by p^(1/T), normalised, where T > 0 is `temperature`."""
        return replace(self, component=lambda raw: tempered_density(self.component(raw), temperature))


class SCVAEHead(LatentHead):
    """Simplified CVAE: an infinite mixture over z ~ N(0, I) (thesis §3.5.2, eq. 3.21-3.22).

    A decoder (plugins.density_head.latent.decoder) turns features and z into a component.

    Args:
        settings: size of the decoder, and number S of samples of z. Without a tolerance, the density in evaluation is a
            mixture of S components for each input, so that memory grows as batch × S × (raw parameters of a component).
        component: the head whose densities are mixed.
    """

    bibtex = "prokudin2018deep"

    def __init__(
        self,
        target: Target,
        *,
        settings: LatentSettings = DEFAULT_SETTINGS,
        component: DensityHead = MODERATE,  # pyright: ignore[reportArgumentType]  # built by the framework
    ) -> None:
        super().__init__(settings, component)
        self.decoder = LatentDecoder(self.latent, self.hidden, component.size)
        self.size = self.decoder.size

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Distribution:
        """Return the density for raw parameters."""
        raw = require_finite(raw, self.size)
        kind = self.decoder.from_latent.weight.dtype
        if self.training:
            z = torch.randn(
                *raw.shape[:-1], self.training_samples, self.latent, dtype=kind, device=raw.device
            )
            number = self.decode(raw, z)
            weights = torch.zeros(number.shape[:-1], dtype=number.dtype, device=number.device)
            return Mixture(weights, self.component(number))
        center = torch.zeros(*raw.shape[:-1], self.latent, dtype=kind, device=raw.device)
        networks = Networks(raw, self.decoder, self.component, center, self.hidden, self.component.size)
        effort = self.effort()
        if self.tolerance is None:
            return sampled_mixture(networks, networks.points(effort), effort)
        return LatentDensity(networks, effort)

    def decode(
        self, raw: Float[Tensor, "*batch size"], z: Float[Tensor, "*batch sample latent"]
    ) -> Float[Tensor, "*batch sample number"]:
        """Return the component's raw parameters at every z, (*batch, sample, number)."""
        return self.decoder(raw.unsqueeze(-2), z)
