"""Mean entropy of predictions, divided into expected entropy and mutual information, with standard errors."""

from typing import ClassVar

import torch
from torch import Tensor
from torchmetrics.utilities.data import dim_zero_cat

from framework.distributions.checks import refuse_nan
from framework.distributions.model_mixtures import expected_entropy
from framework.metric import Metric
from framework.prediction import Prediction


class MutualInformation(Metric):
    """Mean over samples of the entropy of the density and of its two parts, nats (Depeweg et al. 2018).

    - `expected_entropy`: the aleatoric part, the mean entropy of the models of a mixture over models.
    - `mutual_information`: the epistemic part, which is the entropy of the mixture minus `expected_entropy`. It is 0
      for a single model.
    - `total_entropy`: the sum of both parts, which is the entropy of the mixture.

    Each of the three results also has a standard error, with the ending `_sem`.

    Raises:
        UserError: an entropy is NaN.
    """

    bibtex = "depeweg2018decomposition, houlsby2011bayesian"
    columns: ClassVar[dict[str, str]] = {
        "expected_entropy": "aleatoric entropy",
        "mutual_information": "mutual information",
    }

    parts: list[Tensor] | Tensor

    def __init__(self) -> None:
        super().__init__()
        # (entropy, expected entropy, mutual information) of each sample; sums of squares would lose digits of errors
        self.add_state("parts", [], dist_reduce_fx="cat")

    def update(self, prediction: Prediction) -> None:
        if prediction.density.batch_shape.numel() == 0:
            return
        total = refuse_nan(prediction.entropy.double(), "entropies")
        expected = refuse_nan(expected_entropy(prediction.density).double(), "expected entropies")
        assert isinstance(self.parts, list)
        self.parts.append(torch.stack([total, expected, information(total, expected)], -1))

    def compute(self) -> dict[str, Tensor]:
        parts = dim_zero_cat(self.parts) if len(self.parts) else torch.zeros(0, 3, dtype=torch.float64)
        count = len(parts)
        means = parts.mean(0)
        # the standard deviation of one value is NaN, and torch would emit a warning
        errors = parts.std(0) / count**0.5 if count > 1 else torch.full_like(means, torch.nan)
        names = ("total_entropy", "expected_entropy", "mutual_information")
        numbers = {name: means[index] for index, name in enumerate(names)}
        return {**numbers, **{f"{name}_sem": errors[index] for index, name in enumerate(names)}}


def information(total: Tensor, expected: Tensor) -> Tensor:
    """Return the mutual information `total` - `expected`, which is 0 where both are the same infinite entropy."""
    return torch.where(total == expected, 0.0, total - expected)
