"""The contract of an objective: a term of the training loss beyond the head's own."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from framework.data import Batch
from framework.model import Predictor

Share = Annotated[float, Field(ge=0, lt=1)]


@dataclass(frozen=True, kw_only=True)
class Rival:
    """An optimiser of Adam's family for parameters that learn against the predictor's.

    Its step is taken together with the predictor's, from gradients of the same weights: as two optimisers step whose
    losses are computed before either has moved. Its gradients are clipped apart.

    Attributes:
        betas: decay of the moments.
    """

    learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    schedule: Literal["constant", "cosine"] = "constant"
    betas: tuple[Share, Share] = (0.5, 0.999)


class Objective(nn.Module, ABC):
    """A penalty added to the mean loss of every training batch: outlier exposure, adversarial smoothing and the like.

    Keyword-only constructor parameters are the config, among them `weight: float`, the factor it applies itself.
    """

    group: ClassVar[str] = "objective"
    bibtex: ClassVar[str]
    """What to cite, as BibTeX."""

    rival: Rival | None = None
    """How parameters of its own are trained where they learn against the predictor's, as a discriminator does. Their
    loss is part of what `forward` returns; which of the two a term moves is a matter of what is detached in it. None:
    what it has is trained as the predictor is."""
    told: Mapping[str, Tensor] = {}
    """Scalars of the last batch to be logged beside the loss, detached: each term by its name."""

    @abstractmethod
    def forward(self, predictor: Predictor, batch: Batch) -> Float[Tensor, ""]:
        """The weighted penalty on this batch, a scalar in nats, differentiable in the predictor's parameters.

        The loss and the densities of the batch's own inputs cost nothing more where the predictor gives images.
        """
