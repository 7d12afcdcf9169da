"""Brier score (squared error of class probabilities) and its standard error."""

from typing import ClassVar

import torch
from jaxtyping import Float64, Int
from torch import Tensor

from framework.distributions.class_probabilities import require_labels
from framework.metric import Directions, Mean
from framework.prediction import Prediction
from framework.target import Target


class Brier(Mean):
    """Mean Brier score, a proper scoring rule of class probabilities (thesis eq. 2.26), with its standard error.

    For two classes, the score of a sample is the squared error of the second class's probability, in [0, 1]; the metric
    is eq. 2.26 as a mean over samples. For more classes, the score is the sum of the squared errors of all
    probabilities, in [0, 2] (Brier 1950). For two classes, this sum would be twice the score of eq. 2.26.

    Raises:
        ConfigError: the target is not a class.
        UserError: a density has no class probabilities, or NaN among them.
        DataError: a label is not a class of the data set.
    """

    bibtex = "brier1950verification"
    columns: ClassVar[dict[str, str]] = {"brier": "Brier"}
    better: ClassVar[Directions] = {"brier": "lower"}

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("class", by="metric brier")
        self.start()

    def update(self, prediction: Prediction) -> None:
        probability = prediction.class_probabilities
        self.add_samples(brier(probability, require_labels(prediction.target, probability.shape[-1])))

    def compute(self) -> dict[str, Tensor]:
        mean, error = self.mean_and_error()
        return {"brier": mean, "brier_sem": error}


def brier(
    probability: Float64[Tensor, "batch class"], label: Int[Tensor, "batch"]
) -> Float64[Tensor, "batch"]:
    """Return the Brier score of each sample.

    For the label y, the score is (y - p(y = 1))² for two classes (thesis eq. 2.26), and Σ_k (p_k - 1[y = k])² for more
    classes (Brier 1950, eq. 2).
    """
    classes = probability.shape[-1]
    error = probability - torch.nn.functional.one_hot(label, classes)
    return error[:, 1].square() if classes == 2 else error.square().sum(-1)
