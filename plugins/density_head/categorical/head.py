"""Heads of class probabilities: by softmax for any number of classes, or by the logistic function for two classes."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Categorical
from torch.nn.functional import binary_cross_entropy_with_logits

from framework.density_head import DensityHead
from framework.distributions.description import CategoricalDensity
from framework.errors import ConfigError
from framework.heads.parameters import require_finite
from framework.target import Target


class CategoricalHead(DensityHead):
    """Head of any number of classes: probabilities are the softmax of the logits; the loss is the cross-entropy."""

    bibtex = "bridle1990probabilistic"

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("class", by="density_head categorical")
        self.size = len(target.names)

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Categorical:
        """Return the density for raw parameters."""
        return classes(require_finite(raw, self.size))


class BernoulliHead(DensityHead):
    """Head of two classes: the probability of the second class is the logistic function of one logit.

    The loss is the binary cross-entropy (thesis eq. 2.9-2.11).
    """

    bibtex = "cox1958regression"

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("class", by="density_head bernoulli")
        if len(target.names) != 2:
            raise ConfigError(
                f"density_head bernoulli describes exactly two classes, but this data set has {len(target.names)}: "
                f"{target.listed_names}. Choose density_head=categorical."
            )
        self.size = 1

    def forward(self, raw: Float[Tensor, "*batch 1"]) -> Categorical:
        """Return the density for raw parameters."""
        raw = require_finite(raw, self.size)
        # the softmax of (0, r) is the logistic of r (eq. 2.11)
        return classes(torch.cat([torch.zeros_like(raw), raw], -1))

    def loss(self, raw: Float[Tensor, "*batch 1"], target: Tensor) -> Float[Tensor, "*batch"]:
        """Return the negative log-likelihood of each sample, nats.

        It is computed from the logits, which takes less time than building the density.
        """
        raw = require_finite(raw, self.size).squeeze(-1)
        return binary_cross_entropy_with_logits(raw, target.to(raw.dtype), reduction="none")


def classes(logits: Float[Tensor, "*batch label"]) -> Categorical:
    """Return the density of the classes, the softmax of `logits`.

    The logits are clamped, so that differences of two of them do not overflow.
    """
    most = torch.finfo(logits.dtype).max / 4
    # log_softmax subtracts the largest logit first; torch's Categorical does not, and loses digits of large logits.
    return CategoricalDensity(logits=logits.clamp(-most, most).log_softmax(-1), validate_args=False)
