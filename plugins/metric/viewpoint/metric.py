"""Viewpoint accuracy Acc_π/6 and median error MedErr of Tulsiani & Malik (2015), by geodesic distance of rotations."""

import math
from typing import ClassVar

import torch
from torch import Tensor
from torchmetrics.utilities.data import dim_zero_cat

from framework.distributions.sample_median import sample_median
from framework.errors import ConfigError
from framework.geometry.rotation import geodesic_distance, viewpoint_rotation
from framework.metric import Directions, Metric
from framework.prediction import Prediction
from framework.target import Target

ANGLES = ("azimuth", "elevation", "tilt")


class Viewpoint(Metric):
    """Acc_π/6 and MedErr: share of predictions within 30° of the true rotation, and median error in degrees.

    Both use the distance Δ(R₁, R₂) = ||log(R₁ᵀR₂)||_F / √2 between the rotation matrices of the true and the predicted
    viewpoint (Tulsiani & Malik 2015; thesis Table 3.3). The median of an even number of errors is the mean of the
    middle two. Both are returned with their standard errors.

    Raises:
        ConfigError: the target does not consist of the angles azimuth, elevation and tilt.
    """

    bibtex = "tulsiani2015viewpoints"
    columns: ClassVar[dict[str, str]] = {"acc_pi_6": "Acc π/6", "mederr_deg": "MedErr °"}
    better: ClassVar[Directions] = {"acc_pi_6": "higher", "mederr_deg": "lower"}
    errors: list[Tensor] | Tensor

    def __init__(self, target: Target) -> None:
        super().__init__()
        if target.kind != "angle" or sorted(target.names) != sorted(ANGLES):
            raise ConfigError(
                f"metric viewpoint requires the three angles {', '.join(ANGLES)}, but this data "
                f"set's targets are of kind {target.kind!r}: {target.listed_names}. "
                "Leave this metric out; `angular_deviation` evaluates any angles."
            )
        self.order = [target.names.index(name) for name in ANGLES]
        self.add_state("errors", [], dist_reduce_fx="cat")

    def update(self, prediction: Prediction) -> None:
        # float64, because near half a turn float32 rotation matrices resolve only 0.02°
        true = viewpoint_rotation(prediction.target[:, self.order].double())
        predicted = viewpoint_rotation(prediction.point[:, self.order].double())
        assert isinstance(self.errors, list)
        self.errors.append(geodesic_distance(true, predicted))

    def compute(self) -> dict[str, Tensor]:
        errors = dim_zero_cat(self.errors) if len(self.errors) else torch.empty(0, dtype=torch.float64)
        median, median_error = sample_median(errors)
        share = (errors < math.pi / 6).double().mean()
        return {
            "acc_pi_6": share,
            # the standard error of a share p of n is sqrt(p (1 - p) / (n - 1)); it is undefined for one sample: 0/0
            "acc_pi_6_sem": (share * (1 - share) / torch.tensor(max(len(errors) - 1, 0))).sqrt(),
            "mederr_deg": median * (180 / math.pi),
            "mederr_deg_sem": median_error * (180 / math.pi),
        }
