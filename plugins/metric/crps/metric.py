"""Mean continuous ranked probability score, over all numbers of the target and for each number."""

import math
from typing import Annotated, ClassVar

import torch
from pydantic import Field
from torch import Tensor

from framework.distributions.checks import refuse_nan
from framework.metric import Directions, Mean, columns_by_number
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.crps.score import REPLICATES, crps


class CRPS(Mean):
    """Continuous ranked probability score (CRPS): a proper scoring rule in the unit of the target; lower is better.

    `crps` is for real numbers, and `crps_deg` for angles, in degrees. Each number of a target is scored under its
    marginal density. The score of a sample is the mean over its numbers; the mean over samples is reported with its
    standard error. `crps_<name>` is the score of one number of a target with several. If the density is a point mass,
    the score is the absolute deviation of this point from the target.

    If scores are estimated from draws (`score.py`), `crps_mc_error` is the standard error of `crps` that is due to the
    draws only.

    Args:
        samples: number of draws for a density without an exact score.

    Raises:
        ConfigError: the target is a class.
        UserError: scores are NaN.
    """

    bibtex = "grimit2006continuous"
    columns: ClassVar[dict[str, str]] = {"crps": "CRPS"}
    better: ClassVar[Directions] = {"crps": "lower"}
    variance: Tensor

    def __init__(
        self, target: Target, *, samples: Annotated[int, Field(ge=2 * REPLICATES, le=10**6)] = 1000
    ) -> None:
        super().__init__()
        target.refuse(
            "class",
            "metric crps measures distances, but there is no distance between classes (this data set's classes: "
            f"{target.listed_names}). Leave this metric out; for classes, use `brier`.",
        )
        self.samples = samples
        self.unit = "_deg" if target.kind == "angle" else ""
        self.factor = 180 / math.pi if target.kind == "angle" else 1.0
        heading = "CRPS °" if target.kind == "angle" else "CRPS"
        self.columns = columns_by_number(f"crps{self.unit}", heading, target)  # pyright: ignore[reportAttributeAccessIssue]
        self.better = dict.fromkeys(self.columns, "lower")  # pyright: ignore[reportAttributeAccessIssue]
        self.names = target.names
        self.start(len(self.names) + 1)
        self.add_state("variance", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, prediction: Prediction) -> None:
        target = prediction.target
        if len(target) == 0:
            return
        scores = [
            crps(prediction.marginal(index), target[:, index : index + 1], self.samples)
            for index in range(len(self.names))
        ]
        scores_by_number = self.factor * torch.stack([score.mean for score in scores], -1)
        error = self.factor * torch.stack([score.error for score in scores], -1)
        score = torch.cat([scores_by_number.mean(-1, keepdim=True), scores_by_number], -1)
        refuse_nan(score[:, 0], "scores")
        self.add_samples(score)
        # the draws of the marginals are independent: variances add
        self.variance += error.square().sum() / len(self.names) ** 2

    def compute(self) -> dict[str, Tensor]:
        mean, error = self.mean_and_error()
        results = {f"crps{self.unit}": mean[0], f"crps{self.unit}_sem": error[0]}
        if len(self.names) > 1:
            for index, name in enumerate(self.names, start=1):
                results[f"crps_{name}{self.unit}"] = mean[index]
                results[f"crps_{name}{self.unit}_sem"] = error[index]
        if self.variance > 0:
            results[f"crps{self.unit}_mc_error"] = self.variance.sqrt() / self.count
        return results
