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
    `maad_<angle>_deg` is that of one angle. The point is the one that minimises this very loss (thesis eq.
    3.23 and 3.24).

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
        self.take_in(torch.cat([each.mean(-1, keepdim=True), each], -1))

    def compute(self) -> dict[str, Tensor]:
        mean, error = self.mean_and_error()
        found: dict[str, Tensor] = {}
        for index, name in enumerate(self.names):
            found[name] = mean[index]
            found[f"{name}_sem"] = error[index]
        return found


class MedianAngularDeviation(Metric):
    """Median absolute angular deviation of the point prediction, degrees: what half of the samples stay below.

    Of several angles a sample's deviation is their mean, as in `angular_deviation`. The median of an even number is
    the mean of the middle two. It says how well a method does where it does well: of a density with two modes half a
    turn apart, the mean deviation mostly says how often the point prediction took the wrong one.

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
    """The shorter way round from the point prediction to the target, radians, float64."""
    # float64 before the difference: two float32 angles far from 0 differ by a float32 step each
    return angular_distance(prediction.point.double(), prediction.target.double())
