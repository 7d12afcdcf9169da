"""Mean and median absolute angular deviation of the point prediction."""

import math
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics.utilities.data import dim_zero_cat

from framework.distributions.circular import angular_distance
from framework.distributions.sample_median import sample_median
from framework.metric import Directions, Mean, Metric
from framework.prediction import Prediction
from framework.target import Target

BEYER = "beyer2015biternion"
FEW = 3
"""Largest number of angles for which the deviation of each angle is in the result table."""


class MeanAngularDeviation(Mean):
    """Mean absolute angular deviation (MAAD) of the point prediction, degrees, with its standard error.

    The deviation of a sample is the mean over its angles, and `maad_deg` is the mean deviation over samples, with its
    standard error. `maad_<angle>_deg` is the mean deviation of one angle. The point prediction is the value with the
    smallest expected deviation under the density (thesis eq. 3.23 and 3.24). For two or three angles, the result table
    shows the deviation of each angle beside the mean.

    Raises:
        ConfigError: the target does not consist of angles.
    """

    bibtex = BEYER
    columns: ClassVar[dict[str, str]] = {"maad_deg": "MAAD °"}
    better: ClassVar[Directions] = {"maad_deg": "lower"}

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("angle", by="angular_deviation")
        self.names = ("maad_deg", *(f"maad_{name}_deg" for name in target.names))
        if 1 < len(target.names) <= FEW:  # the mean alone would hide the angle with the largest error
            single = {f"maad_{name}_deg": f"{name} MAAD °" for name in target.names}
            self.columns = {**self.columns, **single}  # pyright: ignore[reportAttributeAccessIssue]
        self.start(len(self.names))

    def update(self, prediction: Prediction) -> None:
        deviation_deg = deviations(prediction) * (180 / math.pi)
        self.add_samples(torch.cat([deviation_deg.mean(-1, keepdim=True), deviation_deg], -1))

    def compute(self) -> dict[str, Tensor]:
        mean, error = self.mean_and_error()
        results: dict[str, Tensor] = {}
        for index, name in enumerate(self.names):
            results[name] = mean[index]
            results[f"{name}_sem"] = error[index]
        return results


class MedianAngularDeviation(Metric):
    """Median absolute angular deviation of the point prediction, degrees, with its standard error.

    For several angles, the deviation of a sample is the mean over its angles. The median of an even number of values is
    the mean of the middle two. The median shows how accurate a method is on its better half of the samples. In
    contrast, if densities have two opposite modes, the mean deviation mostly shows how often the point prediction chose
    the wrong mode.

    Raises:
        ConfigError: the target is not made of angles.
    """

    bibtex = BEYER
    columns: ClassVar[dict[str, str]] = {"median_deviation_deg": "median °"}
    better: ClassVar[Directions] = {"median_deviation_deg": "lower"}
    deviations: list[Tensor] | Tensor

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("angle", by="median_deviation")
        self.add_state("deviations", [], dist_reduce_fx="cat")

    def update(self, prediction: Prediction) -> None:
        assert isinstance(self.deviations, list)
        self.deviations.append(deviations(prediction).mean(-1))

    def compute(self) -> dict[str, Tensor]:
        collected = (
            dim_zero_cat(self.deviations) if len(self.deviations) else torch.empty(0, dtype=torch.float64)
        )
        median, error = sample_median(collected)
        return {
            "median_deviation_deg": median * (180 / math.pi),
            "median_deviation_deg_sem": error * (180 / math.pi),
        }


def deviations(prediction: Prediction) -> Float[Tensor, "batch angle"]:
    """Return the angular distance between point prediction and target, at most π, radians, float64."""
    # convert to float64 before the difference, because float32 resolves large angles poorly
    return angular_distance(prediction.point.double(), prediction.target.double())
