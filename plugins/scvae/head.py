"""The simplified conditional variational autoencoder."""

from collections.abc import Mapping
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.density import Mixture
from framework.density_head import DensityHead
from framework.latent_decoder import LatentDecoder
from framework.raw_numbers import require_finite, require_trained
from framework.target import Target

CHUNK = 2**22
"""Most hidden activations held at once in evaluation (16 MiB in float32)."""
MODERATE = {"name": "von_mises", "floor": 1.0}
"""A component that cannot become uniform alone: many still can together, and none stops learning its direction."""


class SCVAEHead(DensityHead):
    """Simplified CVAE: an infinite mixture over z ~ N(0, I) (thesis §3.5.2, eq. 3.21-3.22).

    A decoder (framework.latent_decoder) turns features and z into a component.

    Args:
        latent: dimensions of z.
        hidden: width of the decoder.
        training_samples: S of the training loss.
        samples: S in evaluation; may be set at any time. The density keeps S components per item, so memory
            grows as batch × S × (numbers of a component).
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
        component: DensityHead = MODERATE,  # pyright: ignore[reportArgumentType]  # built by the framework
    ) -> None:
        super().__init__()
        self.latent = latent
        self.training_samples = training_samples
        self.samples = samples
        self.component = require_trained(component)
        self.decoder = LatentDecoder(latent, hidden, component.size)
        self.size = self.decoder.size

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Mixture:
        raw = require_finite(raw, self.size)
        count = self.training_samples if self.training else self.samples
        kind = self.decoder.from_latent.weight.dtype
        z = torch.randn(*raw.shape[:-1], count, self.latent, dtype=kind, device=raw.device)
        step = count if torch.is_grad_enabled() else max(1, CHUNK // max(1, raw.numel()))
        number = torch.cat([self.decode(raw, part) for part in z.split(step, -2)], -2)
        weights = torch.zeros(number.shape[:-1], dtype=number.dtype, device=number.device)
        return Mixture(weights, self.component(number))

    def decode(
        self, raw: Float[Tensor, "*batch size"], z: Float[Tensor, "*batch sample latent"]
    ) -> Float[Tensor, "*batch sample number"]:
        """The component's raw numbers at every z."""
        return self.decoder(raw.unsqueeze(-2), z)

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        return -self(raw).log_prob(target)

    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        pass  # everything is trained
