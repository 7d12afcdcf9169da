"""Accuracy and its standard error, computed from two counts."""

from typing import ClassVar

import torch
from torch import Tensor

from framework.distributions.class_probabilities import require_labels
from framework.metric import Directions, Metric
from framework.prediction import Prediction
from framework.target import Target


class Accuracy(Metric):
    """Share of samples whose most likely class is the true one (thesis Table 2.1), with its standard error.

    If several classes are equally likely, the first of them is the prediction.

    Raises:
        ConfigError: the target is not a class.
        UserError: a density has no class probabilities, or NaN among them.
        DataError: a label is not a class of the target.
    """

    bibtex = "hastie2009elements"
    columns: ClassVar[dict[str, str]] = {"accuracy": "accuracy"}
    better: ClassVar[Directions] = {"accuracy": "higher"}
    count: Tensor
    right: Tensor

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("class", by="metric accuracy")
        zero = torch.zeros((), dtype=torch.float64)
        self.add_state("count", zero, dist_reduce_fx="sum")
        self.add_state("right", zero.clone(), dist_reduce_fx="sum")

    def update(self, prediction: Prediction) -> None:
        probability = prediction.class_probabilities
        label = require_labels(prediction.target, probability.shape[-1])
        self.count += len(label)
        self.right += (probability.argmax(-1) == label).sum()

    def compute(self) -> dict[str, Tensor]:
        share = self.right / self.count
        # the sample variance of zeros and ones is n a (1 - a) / (n - 1); it is undefined for one sample: 0/0
        error = (share * (1 - share) / (self.count - 1).clamp(min=0)).sqrt()
        return {"accuracy": share, "accuracy_sem": error}
