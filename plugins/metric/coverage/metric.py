"""Calibration of densities of any kind by their highest-density regions."""

import math
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor

from framework.distributions.checks import refuse_nan
from framework.metric import HasFigure, Metric
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.coverage.functional import border, covered

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVELS = 19
"""Nominal masses 0.05, 0.10, ..., 0.95."""
REGION = 0.9
"""Mass of the region whose size is reported."""


class Coverage(Metric, HasFigure):
    """Share of targets that lie in the highest-density regions of given masses.

    The mass h(x, y) of all values that are at least as dense as the target is uniform on [0, 1] where the densities are
    the true ones. This holds for targets of every kind: classes, reals, angles, rotations.

    - `coverage_50`, `coverage_90`: share of targets within the regions of mass 0.5 and 0.9.
    - `coverage_error`: mean |share - mass| over the masses 0.05, 0.10, ..., 0.95.
    - `region_90_labels`, `region_90_deg` or `region_90` (in the unit of the target): mean size of the region of mass
      0.9, for classes, one angle and one real. Of two forecasters with the right coverage, the one with smaller regions
      is better.

    Where many values are equally dense, as classes often are, h is any number between two masses; a target then counts
    with the probability that a number drawn uniformly between them lies below the level.

    Args:
        samples: draws for a density whose regions are not known: several angles, rotations, mixtures over reals. Each
            needs log_prob of that many values.

    Raises:
        UserError: densities are NaN; the message says how many.
        DataError: a target is not a class of the data set.
    """

    bibtex = """@article{hyndman1996computing,
  author  = {Hyndman, Rob J.},
  title   = {Computing and Graphing Highest Density Regions},
  journal = {The American Statistician},
  volume  = {50},
  number  = {2},
  pages   = {120--126},
  year    = {1996}
}"""
    columns: ClassVar[dict[str, str]] = {
        "coverage_50": "cover 50 %",
        "coverage_90": "cover 90 %",
        "coverage_error": "coverage error",
    }
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = {"coverage_error": "lower"}
    figure_name: ClassVar[str] = "coverage"
    count: Tensor
    inside: Tensor
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
        self.add_state("inside", torch.zeros(LEVELS, dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("size", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, prediction: Prediction) -> None:
        target = prediction.target
        if len(target) == 0:
            return
        found = border(prediction.density, target, REGION, self.samples)
        refuse_nan(found.low + found.high, "masses of regions")
        self.count += len(target)
        self.inside += covered(found.low, found.high, self._levels()).sum(0)
        self.size += self.factor * found.size.sum()

    def compute(self) -> dict[str, Tensor]:
        share = self.inside / self.count
        found = {
            "coverage_50": share[9],
            "coverage_90": share[17],
            "coverage_error": (share - self._levels()).abs().mean(),
        }
        return found if self.unit is None else found | {self.unit: self.size / self.count}

    def figure(self, title: str, *, synthetic: bool) -> "Figure":
        from plugins.metric.coverage.picture import curve

        share = (self.inside / self.count).cpu().numpy()
        return curve(self._levels().cpu().numpy(), share, int(self.count), title, synthetic=synthetic)

    def _levels(self) -> Tensor:
        """Return the nominal masses 0.05, 0.10, ..., 0.95."""
        return torch.arange(1, LEVELS + 1, dtype=torch.float64, device=self.count.device) / (LEVELS + 1)
