"""The simplified conditional variational autoencoder."""

from collections.abc import Mapping
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.distributions import Distribution

from framework.density_head import DensityHead
from framework.distributions.density import Mixture
from framework.distributions.monte_carlo import Effort
from framework.heads.parameters import require_finite, require_trained
from framework.target import Target
from plugins.density_head.latent.decoder import LatentDecoder
from plugins.density_head.latent.scvae.density import Networks, SCVAEDensity, sampled_mixture

MODERATE = {"name": "von_mises", "floor": 1.0}
"""A component that cannot become uniform alone: many still can together, and none stops learning its direction."""


class SCVAEHead(DensityHead):
    """Simplified CVAE: an infinite mixture over z ~ N(0, I) (thesis §3.5.2, eq. 3.21-3.22).

    A decoder (plugins.density_head.latent.decoder) turns features and z into a component.

    Args:
        latent: dimensions of z.
        hidden: width of the decoder.
        training_samples: S of the training loss.
        samples: S in evaluation; may be set at any time. The density keeps S components per item, so memory
            grows as batch × S × (numbers of a component).
        tolerance: nats; may be set at any time. In evaluation log_prob then draws `samples` and doubles them until its
            estimated error is below. None: S it is, and the density is a mixture of S components.
        component: the head whose densities are mixed.
    """

    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {"samples": (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)}
    bibtex = """@inproceedings{prokudin2018deep,
  title = {Deep Directional Statistics: Pose Estimation with Uncertainty Quantification},
  author = {Prokudin, Sergey and Gehler, Peter and Nowozin, Sebastian},
  booktitle = {European Conference on Computer Vision (ECCV)},
  year = {2018}
}"""

    def __init__(
        self,
        target: Target,
        *,
        latent: Annotated[int, Field(ge=1)] = 2,
        hidden: Annotated[int, Field(ge=1)] = 128,
        training_samples: Annotated[int, Field(ge=1)] = 50,
        samples: Annotated[int, Field(ge=1)] = 500,
        tolerance: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None,
        component: DensityHead = MODERATE,  # pyright: ignore[reportArgumentType]  # built by the framework
    ) -> None:
        super().__init__()
        self.latent = latent
        self.training_samples = training_samples
        self.samples = samples
        self.tolerance = tolerance
        self.hidden = hidden
        self.component = require_trained(component)
        self.decoder = LatentDecoder(latent, hidden, component.size)
        self.size = self.decoder.size

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Distribution:
        raw = require_finite(raw, self.size)
        kind = self.decoder.from_latent.weight.dtype
        if self.training:
            z = torch.randn(
                *raw.shape[:-1], self.training_samples, self.latent, dtype=kind, device=raw.device
            )
            number = self.decode(raw, z)
            weights = torch.zeros(number.shape[:-1], dtype=number.dtype, device=number.device)
            return Mixture(weights, self.component(number))
        networks = Networks(raw, self.decoder, self.component, self.latent, self.hidden, kind)
        effort = Effort(self.samples, self.tolerance)
        if self.tolerance is None:
            return sampled_mixture(networks, networks.points(effort), effort)
        return SCVAEDensity(networks, effort)

    def decode(
        self, raw: Float[Tensor, "*batch size"], z: Float[Tensor, "*batch sample latent"]
    ) -> Float[Tensor, "*batch sample number"]:
        """The component's raw numbers at every z."""
        return self.decoder(raw.unsqueeze(-2), z)

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        return -self(raw).log_prob(target)

    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        pass  # everything is trained
