"""The contract of an objective: a term that is added to the training loss of the density head."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from framework.data import Batch, Data
from framework.model import Predictor

Share = Annotated[float, Field(ge=0, lt=1)]
"""Config value that is a share: a number in [0, 1)."""


@dataclass(frozen=True, kw_only=True)
class AdversaryOptimizer:
    """Optimiser of Adam's family for an adversary's parameters, which are trained against the predictor's.

    The step of this optimiser is taken together with the predictor's step, from gradients at the same weights. This
    equals two optimisers whose losses are both computed before either of them steps. Gradients are clipped separately.

    Attributes:
        learning_rate: factor on the optimiser's steps.
        schedule: change of the learning rate: none, or half a cosine to 0.
        betas: decay rates of the moments.
    """

    learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    schedule: Literal["constant", "cosine"] = "constant"
    betas: tuple[Share, Share] = (0.5, 0.999)


class Objective(nn.Module, ABC):
    """Penalty on every training batch, added to its mean loss.

    Examples are outlier exposure and adversarial smoothing. Keyword-only constructor parameters are the config. One of
    them is `weight: float`, the factor that the objective applies itself.
    """

    group: ClassVar[str] = "objective"
    bibtex: ClassVar[str]
    """Citation of the method: BibTeX entries, or their keys in the `references.bib` of the package; "" for none."""

    adversary_optimizer: AdversaryOptimizer | None = None
    """Optimiser of the objective's own parameters, if they are trained against the predictor's.

    The parameters of a discriminator are an example. Their loss is part of the value that `forward` returns. A term
    trains only the side, predictor or adversary, whose values it does not detach. None: the objective's parameters are
    trained by the predictor's optimiser.
    """
    logged_terms: Mapping[str, Tensor] = {}
    """Detached scalars of the last batch that are logged beside the loss, by the name of the term."""

    def check_data(self, data: Data, config: Mapping[str, Any]) -> None:
        """Refuse data to which the objective does not apply; called once before training.

        The default accepts all data.

        Args:
            data: the data set of the run, prepared.
            config: resolved config of the data set.

        Raises:
            ConfigError: the objective does not apply to the data.
        """

    @abstractmethod
    def forward(self, predictor: Predictor, batch: Batch) -> Float[Tensor, ""]:
        """Return the weighted penalty on this batch, a scalar in nats, differentiable in the predictor's parameters.

        The penalty is a mean over the samples of the batch; it is a finite number, such as 0, for an empty batch, and
        NaN or an error if the predictor returns NaN. The densities of a wrapper of several models have the batch_shape
        (batch, member); `framework.model.independent_penalty` combines penalties of this shape, so that each member
        trains as it would train alone.

        The method changes neither the batch nor the predictor. A further pass of inputs through the predictor would
        change the running moments of batch norm, unless it stands in a block of `module_flags.set_flag(predictor,
        BATCH_NORM, "track_running_stats", False)`. Random numbers come from torch's global generator.

        If the predictor predicts images, the images for the inputs of `batch` were computed for the loss already, and
        are reused (`framework.model.one_pass`).
        """
