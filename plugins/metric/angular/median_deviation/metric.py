"""Median absolute angular deviation."""

import math
from typing import ClassVar, Literal

import torch
from torch import Tensor
from torchmetrics.utilities.data import dim_zero_cat

from framework.distributions.circular import angular_distance
from framework.metric import Metric
from framework.prediction import Prediction
from framework.target import Target


class MedianAngularDeviation(Metric):
    """Median absolute angular deviation of the point prediction, degrees: what half of the samples stay below.

    Of several angles a sample's deviation is their mean, as in `angular_deviation`. The median of an even number is
    the mean of the middle two. It says how well a method does where it does well: of a density with two modes half a
    turn apart, the mean deviation mostly says how often the point prediction took the wrong one.

    Raises:
        ConfigError: the target is not made of angles.
    """

    bibtex = """@inproceedings{beyer2015biternion,
  author    = {Beyer, Lucas and Hermans, Alexander and Leibe, Bastian},
  title     = {Biternion Nets: Continuous Head Pose Regression from Discrete Training Labels},
  booktitle = {German Conference on Pattern Recognition},
  pages     = {157--168},
  year      = {2015}
}"""
    columns: ClassVar[dict[str, str]] = {"median_deviation_deg": "median °"}
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = {"median_deviation_deg": "lower"}
    deviations: list[Tensor] | Tensor

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("angle", by="median_deviation")
        self.add_state("deviations", [], dist_reduce_fx="cat")

    def update(self, prediction: Prediction) -> None:
        each = angular_distance(prediction.point.double(), prediction.target.double())
        assert isinstance(self.deviations, list)
        self.deviations.append(each.mean(-1))

    def compute(self) -> dict[str, Tensor]:
        found = dim_zero_cat(self.deviations) if len(self.deviations) else torch.empty(0, dtype=torch.float64)
        median = found.quantile(0.5) if len(found) else found.new_tensor(torch.nan)
        return {"median_deviation_deg": median * (180 / math.pi)}
