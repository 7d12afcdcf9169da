"""Coverage and size of prediction sets, and share of empty sets."""

import math
from typing import ClassVar

import torch
from torch import Tensor
from torchmetrics.utilities.data import dim_zero_cat

from framework.distributions.protocol import value_set
from framework.errors import UserError, quote, shorten
from framework.metric import Directions, Metric
from framework.prediction import Prediction
from framework.target import Target

MISSED, ERRORS = 0.05, 4
"""Smallest difference between stated and found coverage that is reported, also in standard errors."""
FEWEST = 10
"""Smallest number of samples whose coverage is reported."""


class PredictionSetMetric(Metric):
    """Coverage and mean size of the predicted sets, and the share of empty sets, with their standard errors.

    - `set_coverage`: share of targets in their sets; best: the stated probability.
    - `set_size`: mean size of the sets. It is the number of labels for classes, the length or volume in the target's
      unit for real numbers, and the volume in radⁿ for n > 1 angles. For one angle, the result is `set_size_deg`, the
      mean length of the arcs in degrees. The mean size is infinite if a set is unbounded, and its standard error is
      then NaN.
    - `set_empty`: share of empty sets. An empty set shows that the input is unlike the calibration data.

    Raises:
        UserError: the predicted densities have no sets, or are NaN.
    """

    bibtex = "vovk2005algorithmic"
    columns: ClassVar[dict[str, str]] = {}
    better: ClassVar[Directions] = {}
    count: Tensor
    covered: Tensor
    sizes: list[Tensor] | Tensor
    empty: Tensor
    by_class: Tensor

    def __init__(self, target: Target) -> None:
        super().__init__()
        degrees = target.kind == "angle" and len(target.names) == 1
        self.key = "set_size_deg" if degrees else "set_size"
        self.unit = 180 / math.pi if degrees else 1.0
        self.columns = {  # pyright: ignore[reportAttributeAccessIssue]  # the unit is the target's
            "set_coverage": "coverage",
            self.key: "set size °" if degrees else "set size",
            "set_empty": "empty sets",
        }
        self.stated: float | None = None
        self.classes = target.names if target.kind == "class" else ()
        self.better = {self.key: "lower"}  # pyright: ignore[reportAttributeAccessIssue]
        for name in ("count", "covered", "empty"):
            self.add_state(name, torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        # all sizes, because sums of squares lose the digits of the spread if the sizes are nearly equal
        self.add_state("sizes", [], dist_reduce_fx="cat")
        # number of test samples of each class, and of those in their sets
        self.add_state(
            "by_class", torch.zeros(len(self.classes), 2, dtype=torch.float64), dist_reduce_fx="sum"
        )

    def update(self, prediction: Prediction) -> None:
        if len(prediction.target) == 0:
            return
        sets = value_set(prediction.density)
        if sets is None:
            raise UserError(
                f"metric prediction_set requires prediction sets, but the model predicts a "
                f"{type(prediction.density).__name__}, which has none. Add conformal as the last wrapper, "
                "uncertainty=[..., conformal], or leave this metric out."
            )
        self.stated = sets.stated_probability
        size = prediction.set_size(sets)
        broken = (size.isnan() | prediction.log_prob.isnan()).nonzero().flatten()
        if len(broken):
            index = prediction.batch.get("index")
            names = broken if index is None else index[broken]
            raise UserError(
                f"The densities of samples {names[:10].tolist()} are NaN and have no set. Check these samples, and "
                "check "
                "whether the training diverged."
            )
        self.count += len(size)
        inside = sets.contains(prediction.target)
        self.covered += inside.sum()
        if self.classes:
            counts = torch.stack([torch.ones_like(size), inside.to(size)], -1).double()
            self.by_class.index_add_(0, prediction.target.long(), counts)
        assert isinstance(self.sizes, list)
        self.sizes.append(self.unit * size.double())
        self.empty += sets.empty().sum()

    def compute(self) -> dict[str, Tensor]:
        coverage, empty = self.covered / self.count, self.empty / self.count
        sizes = dim_zero_cat(self.sizes) if len(self.sizes) else coverage.new_zeros(0)
        size = sizes.sum() / self.count
        # the mean square of zeros and ones is their mean
        spreads = (
            coverage - coverage.square(),
            (sizes - size).square().sum() / self.count,
            empty - empty.square(),
        )
        coverage_error, size_error, empty_error = (
            (spread / (self.count - 1).clamp(min=0)).sqrt() for spread in spreads
        )
        return {
            "set_coverage": coverage,
            "set_coverage_sem": coverage_error,
            self.key: size,
            f"{self.key}_sem": size_error,
            "set_empty": empty,
            "set_empty_sem": empty_error,
        }

    def remarks(self) -> tuple[str, ...]:
        if self.stated is None:
            return ()
        if self._misses(float(self.covered), float(self.count)):
            share = float(self.covered / self.count)
            return (
                f"prediction_set: the sets hold {100 * share:.3g} % of the test targets, but {100 * self.stated:.4g} % "
                "are stated. The test samples differ from the validation samples that set the threshold, as later rows "
                "or other groups do, or these are few. Rely neither on the sets nor on the densities for such samples.",
            )
        missed = [
            f"{covered / count:.0%} of {count:.0f} {quote(name)}"
            for name, (count, covered) in zip(self.classes, self.by_class.tolist(), strict=True)
            if self._misses(covered, count)
        ]
        if not missed:
            return ()
        return (
            f"prediction_set: the sets hold {100 * self.stated:.4g} % of the targets on average over classes, but not "
            f"of each class: {shorten(', '.join(missed), 200)}. A set without such a class does not exclude it.",
        )

    def _misses(self, covered: float, count: float) -> bool:
        """Return whether a share of covered targets is below the stated one by more than chance explains."""
        assert self.stated is not None
        if count < FEWEST:
            return False
        chance = ERRORS * math.sqrt(self.stated * (1 - self.stated) / count)
        return self.stated - covered / count > max(MISSED, chance)
