"""Calibration of densities of any kind by their highest-density regions."""

import math
from typing import TYPE_CHECKING, Annotated, ClassVar

import torch
from pydantic import Field
from torch import Tensor
from torchmetrics.utilities.data import dim_zero_cat

from framework.distributions.checks import refuse_nan
from framework.metric import Directions, HasFigure, Metric, jackknife_error
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.coverage.functional import border, coverage_probability

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVELS = 19
"""Number of nominal masses 0.05, 0.10, ..., 0.95."""
REGION = 0.9
"""Mass of the region whose size is reported."""


class Coverage(Metric, HasFigure):
    """Share of targets that lie in the highest-density regions of given masses.

    Let h be the probability of all values whose density is at least that of the target. If the predicted densities are
    the true ones, h is uniform on [0, 1]. This holds for classes, real numbers, angles and rotations.

    - `coverage_50`, `coverage_90`: share of targets within the regions of mass 0.5 and 0.9, with standard errors.
    - `coverage_error`: mean |share - mass| over the masses 0.05, 0.10, ..., 0.95, with a standard error by the
      jackknife. It does not contain the bias: by chance, the error of a calibrated model is larger than 0.
    - `region_90_labels`, `region_90_deg` or `region_90` (in the unit of the target): mean size of the region of mass
      0.9, for classes, one angle and one real number. Of two models with the right coverage, the one with smaller
      regions is better.

    If many values have the same density as the target, as classes often do, h can be any number between two masses:
    the mass of all values with a higher density, and the mass of all values whose density is at least that of the
    target. The target then counts with the probability that a number drawn uniformly between these two masses is at
    most the mass of the region.

    Args:
        samples: number of draws for a density whose regions are not known: several angles, rotations, mixtures over
            real numbers. For each sample, log_prob is evaluated at all draws.

    Raises:
        UserError: densities are NaN.
        DataError: a target is not a class of the data set.
    """

    bibtex = "hyndman1996computing"
    columns: ClassVar[dict[str, str]] = {
        "coverage_50": "cover 50 %",
        "coverage_90": "cover 90 %",
        "coverage_error": "coverage error",
    }
    better: ClassVar[Directions] = {"coverage_error": "lower"}
    figure_name: ClassVar[str] = "coverage"
    count: Tensor
    inside: list[Tensor] | Tensor
    size: Tensor

    def __init__(self, target: Target, *, samples: Annotated[int, Field(ge=20, le=10**6)] = 200) -> None:
        super().__init__()
        self.samples = samples
        self.unit: str | None = "region_90"
        self.factor = 1.0
        if target.kind == "class":
            self.unit = "region_90_labels"
        elif len(target.names) > 1:
            self.unit = None
        elif target.kind == "angle":
            self.unit, self.factor = "region_90_deg", 180 / math.pi
        self.add_state("count", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        # probability of each target to lie in the region of each mass, because the jackknife leaves out one target
        self.add_state("inside", [], dist_reduce_fx="cat")
        self.add_state("size", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, prediction: Prediction) -> None:
        target = prediction.target
        if len(target) == 0:
            return
        result = border(prediction.density, target, REGION, self.samples)
        refuse_nan(result.low + result.high, "masses of regions")
        self.count += len(target)
        assert isinstance(self.inside, list)
        self.inside.append(coverage_probability(result.low, result.high, self._levels()))
        self.size += self.factor * result.size.sum()

    def compute(self) -> dict[str, Tensor]:
        inside, levels = self._inside(), self._levels()
        share = inside.sum(0) / self.count
        error = (((inside - share).square().sum(0) / self.count) / (self.count - 1).clamp(min=0)).sqrt()
        without = (inside.sum(0) - inside) / (self.count - 1)
        errors_without = (without - levels).abs().mean(-1)
        results = {
            "coverage_50": share[9],
            "coverage_50_sem": error[9],
            "coverage_90": share[17],
            "coverage_90_sem": error[17],
            "coverage_error": (share - levels).abs().mean(),
            "coverage_error_sem": jackknife_error(errors_without),
        }
        return results if self.unit is None else results | {self.unit: self.size / self.count}

    def figure(self, title: str, *, synthetic: bool) -> "Figure":
        from plugins.metric.coverage.picture import curve

        share = (self._inside().sum(0) / self.count).cpu().numpy()
        return curve(self._levels().cpu().numpy(), share, int(self.count), title, synthetic=synthetic)

    def _inside(self) -> Tensor:
        """Return the probability of each target to lie in the region of each mass, (sample, mass)."""
        return dim_zero_cat(self.inside) if len(self.inside) else self._levels().new_zeros(0, LEVELS)

    def _levels(self) -> Tensor:
        """Return the nominal masses 0.05, 0.10, ..., 0.95."""
        return torch.arange(1, LEVELS + 1, dtype=torch.float64, device=self.count.device) / (LEVELS + 1)
