"""The conditional variational autoencoder head."""

from collections.abc import Mapping
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from framework.density_head import DensityHead
from framework.distributions.monte_carlo import Effort
from framework.heads.parameters import require_finite, require_trained
from framework.target import Target
from plugins.density_head.latent.cvae.density import CVAEDensity, Gaussian, Networks, evidence_bound
from plugins.density_head.latent.decoder import LARGEST_FEATURE, LatentDecoder

LARGEST_LOG_SCALE = 7.0
"""Standard deviations of z stay within e^±7, so that no ratio of two of them overflows."""
MODERATE = {"name": "von_mises", "floor": 1.0}
"""A component that cannot become uniform alone: many still can together, and none stops learning its direction."""


class CVAEHead(DensityHead):
    """CVAE: an infinite mixture over a latent z with a learned prior (thesis §3.5.2, eq. 3.12-3.20).

    Prior p(z|x), encoder q(z|x,φ) and decoder p(φ|x,z) train by the evidence lower bound (eq. 3.17-3.18);
    log_prob is the importance-weighted bound (eq. 3.19). The framework's linear layer is
    the part of each network's first layer that sees the features, computed once per item.

    Args:
        latent: dimensions of z.
        hidden: width of each of the three networks.
        training_samples: S of the training loss.
        samples: S in evaluation, of the bound and of the mixture it is drawn as; may be set at any time.
        tolerance: nats; may be set at any time. In evaluation log_prob then draws `samples` and doubles them until its
            estimated error is below. None: S it is.
        component: the head whose densities are mixed.
    """

    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {"samples": (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)}
    bibtex = """@inproceedings{sohn2015learning,
  title = {Learning Structured Output Representation using Deep Conditional Generative Models},
  author = {Sohn, Kihyuk and Lee, Honglak and Yan, Xinchen},
  booktitle = {Advances in Neural Information Processing Systems (NIPS)},
  year = {2015}
}
@inproceedings{burda2016importance,
  title = {Importance Weighted Autoencoders},
  author = {Burda, Yuri and Grosse, Roger and Salakhutdinov, Ruslan},
  booktitle = {International Conference on Learning Representations (ICLR)},
  year = {2016}
}"""

    def __init__(
        self,
        target: Target,
        *,
        latent: Annotated[int, Field(ge=1)] = 8,
        hidden: Annotated[int, Field(ge=1)] = 128,
        training_samples: Annotated[int, Field(ge=1)] = 10,
        samples: Annotated[int, Field(ge=1)] = 500,
        tolerance: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None,
        component: DensityHead = MODERATE,  # pyright: ignore[reportArgumentType]  # built by the framework
    ) -> None:
        super().__init__()
        self.target = target
        self.hidden = hidden
        self.training_samples = training_samples
        self.samples = samples
        self.tolerance = tolerance
        self.component = require_trained(component)
        self.prior = _rest(hidden, 2 * latent)
        self.from_value = nn.Linear(
            len(target.names) * (2 if target.kind == "angle" else 1), hidden, bias=False
        )
        self.posterior = _rest(hidden, 2 * latent)
        self.decoder = LatentDecoder(latent, hidden, component.size)
        self.size = 2 * hidden + self.decoder.size

    def forward(self, raw: Float[Tensor, "*batch size"]) -> CVAEDensity:
        effort = Effort(self.training_samples) if self.training else Effort(self.samples, self.tolerance)
        return CVAEDensity(self.networks(raw), effort)

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        return -evidence_bound(self.networks(raw), target, self.training_samples)

    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        pass  # everything is trained

    def networks(self, raw: Float[Tensor, "*batch size"]) -> Networks:
        """Prior, encoder and decoder, given the features."""
        raw = require_finite(raw, self.size)
        # so that no raw number, however large, overflows in the layers behind
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
        )

    def encode(self, value: Tensor) -> Tensor:
        """What the encoder sees of a target: angles as biternions, labels one-hot, reals as they are."""
        if self.target.kind == "angle":
            return torch.cat([value.cos(), value.sin()], -1)
        if self.target.kind == "class":
            return nn.functional.one_hot(value, len(self.target.names))
        return value


def _rest(hidden: int, numbers: int) -> nn.Sequential:
    """A network behind its linear first layer."""
    return nn.Sequential(nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, numbers))


def _gaussian(number: Tensor) -> Gaussian:
    if number.dtype in (torch.float16, torch.bfloat16):  # under autocast
        number = number.float()
    mean, log_scale = number.chunk(2, -1)
    return Gaussian(mean, LARGEST_LOG_SCALE * torch.tanh(log_scale / LARGEST_LOG_SCALE))
