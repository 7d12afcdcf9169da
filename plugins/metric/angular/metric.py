"""Mean and median absolute angular deviation of the point prediction."""

import math
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics.utilities.data import dim_zero_cat

from framework.distributions.circular import angular_distance
from framework.metric import Mean, Metric
from framework.prediction import Prediction
from framework.target import Target

BEYER = """@inproceedings{beyer2015biternion,
  author    = {Beyer, Lucas and Hermans, Alexander and Leibe, Bastian},
  title     = {Biternion Nets: Continuous Head Pose Regression from Discrete Training Labels},
  booktitle = {German Conference on Pattern Recognition},
  pages     = {157--168},
  year      = {2015}
}"""


class MeanAngularDeviation(Mean):
    """Mean absolute angular deviation (MAAD) of the point prediction, degrees, with its standard error.

    `maad_deg` takes the mean over the angles of a sample first, so that its standard error counts samples;
    `maad_<angle>_deg` is the deviation of one angle. The point prediction is the one that minimises this loss (thesis
    eq. 3.23 and 3.24).

    Raises:
        ConfigError: the target is not made of angles.
    """

    bibtex = BEYER
    columns: ClassVar[dict[str, str]] = {"maad_deg": "MAAD °"}
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = {"maad_deg": "lower"}

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("angle", by="angular_deviation")
        self.names = ("maad_deg", *(f"maad_{name}_deg" for name in target.names))
        self.start(len(self.names))

    def update(self, prediction: Prediction) -> None:
        each = deviations(prediction) * (180 / math.pi)
        self.add_samples(torch.cat([each.mean(-1, keepdim=True), each], -1))

    def compute(self) -> dict[str, Tensor]:
        mean, error = self.mean_and_error()
        found: dict[str, Tensor] = {}
        for index, name in enumerate(self.names):
            found[name] = mean[index]
            found[f"{name}_sem"] = error[index]
        return found


class MedianAngularDeviation(Metric):
    """Median absolute angular deviation of the point prediction, degrees: half of the samples stay below it.

    For several angles a sample's deviation is their mean, as in `angular_deviation`. The median of an even number is
    the mean of the middle two. The median shows how accurate a method is on its good samples. The mean deviation of a
    density with two modes half a turn apart instead mostly shows how often the point prediction took the wrong mode.

    Raises:
        ConfigError: the target is not made of angles.
    """

    bibtex = BEYER
    columns: ClassVar[dict[str, str]] = {"median_deviation_deg": "median °"}
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = {"median_deviation_deg": "lower"}
    deviations: list[Tensor] | Tensor

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("angle", by="median_deviation")
        self.add_state("deviations", [], dist_reduce_fx="cat")

    def update(self, prediction: Prediction) -> None:
        assert isinstance(self.deviations, list)
        self.deviations.append(deviations(prediction).mean(-1))

    def compute(self) -> dict[str, Tensor]:
        found = dim_zero_cat(self.deviations) if len(self.deviations) else torch.empty(0, dtype=torch.float64)
        median = found.quantile(0.5) if len(found) else found.new_tensor(torch.nan)
        return {"median_deviation_deg": median * (180 / math.pi)}


def deviations(prediction: Prediction) -> Float[Tensor, "batch angle"]:
    """Return the shorter angular distance from the point prediction to the target, radians, float64."""
    # convert to float64 before the difference: float32 angles far from 0 are coarse
    return angular_distance(prediction.point.double(), prediction.target.double())
