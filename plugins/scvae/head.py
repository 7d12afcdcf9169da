"""The simplified conditional variational autoencoder."""

from typing import Annotated, cast

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from framework.density import Mixture
from framework.density_head import DensityHead
from framework.errors import ConfigError
from framework.target import Target

CHUNK = 2**22
"""Most hidden activations held at once in evaluation (16 MiB in float32)."""


class SCVAEHead(DensityHead):
    """Infinite mixture over z ~ N(0, I): a decoder turns features and z into a component (thesis eq. 3.21-3.22).

    The decoder's first layer is linear in (features, z), so it is the sum of the framework's linear layer, computed
    once per item, and a layer of z alone, computed once per sample.

    Args:
        latent: dimensions of z.
        hidden: width of the decoder, and the numbers read per item.
        training_samples: S of the training loss.
        samples: S in evaluation; may be set at any time. The density keeps S components per item, so memory grows
            as batch × S × (numbers of a component).
        component: the head whose densities are mixed.
    """

    knobs = {"samples": (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)}
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
        latent: Annotated[int, Field(ge=1)] = 8,
        hidden: Annotated[int, Field(ge=1)] = 128,
        training_samples: Annotated[int, Field(ge=1)] = 50,
        samples: Annotated[int, Field(ge=1)] = 500,
        component: DensityHead = cast(DensityHead, "von_mises"),
    ) -> None:
        super().__init__()
        fitted = set(component.state_dict()) - {name for name, _ in component.named_parameters()}
        if fitted:
            raise ConfigError(
                f"density_head.component fits {', '.join(sorted(fitted))} after training, which a component of a "
                "mixture cannot; choose one that predicts it, such as concentration=predicted."
            )
        self.size = hidden
        self.latent = latent
        self.training_samples = training_samples
        self.samples = samples
        self.component = component
        self.from_latent = nn.Linear(latent, hidden, bias=False)
        self.decoder = nn.Sequential(
            nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, component.size)
        )

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Mixture:
        if raw.shape[-1] != self.size:
            raise ValueError(
                f"raw numbers of shape {tuple(raw.shape)}; wanted {self.size} in the last dimension."
            )
        bad = ~raw.isfinite().all(-1)
        if bad.any():
            row = tuple(bad.nonzero()[0].tolist())
            raise ValueError(f"raw numbers are not finite in batch row {row[0] if len(row) == 1 else row}.")
        count = self.training_samples if self.training else self.samples
        batch = raw.shape[:-1]
        if torch.is_grad_enabled():
            step = count
        else:
            step = max(1, CHUNK // max(1, raw.numel()))
        parts = [self.decode(raw, min(step, count - done)) for done in range(0, count, step)]
        number = torch.cat(parts, -2)
        weights = torch.zeros(*batch, count, dtype=number.dtype, device=number.device)
        return Mixture(weights, self.component(number))

    def decode(self, raw: Float[Tensor, "*batch size"], count: int) -> Float[Tensor, "*batch count number"]:
        """The component's raw numbers for `count` fresh z per item."""
        kind = self.from_latent.weight
        z = torch.randn(*raw.shape[:-1], count, self.latent, dtype=kind.dtype, device=raw.device)
        # past 1e30 the layers behind would overflow; nothing is learned there
        features = raw.to(kind.dtype).clamp(-1e30, 1e30).unsqueeze(-2)
        return self.decoder(features + self.from_latent(z))

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        return -self(raw).log_prob(target)

    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        pass  # everything is trained
