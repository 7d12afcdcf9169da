"""The contract of an objective: a term of the training loss beyond the head's own."""

from abc import ABC, abstractmethod
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor, nn

from framework.data import Batch
from framework.model import Predictor


class Objective(nn.Module, ABC):
    """A penalty added to the mean loss of every training batch: outlier exposure, adversarial smoothing and the like.

    Keyword-only constructor parameters are the config, among them `weight: float`, the factor it applies itself.
    """

    group: ClassVar[str] = "objective"
    bibtex: ClassVar[str]
    """What to cite, as BibTeX."""

    @abstractmethod
    def forward(self, predictor: Predictor, batch: Batch) -> Float[Tensor, ""]:
        """The weighted penalty on this batch, a scalar in nats, differentiable in the predictor's parameters."""
