"""CV+ intervals of one real number, from models that each left out a part of the samples (Barber et al. 2021)."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.distributions.exported import Exported, exported
from framework.distributions.protocol import ValueSet, marginal, median
from framework.distributions.unchanged import Unchanged
from framework.errors import ConfigError
from framework.model import Predictor
from framework.uncertainty import SelfTraining

ENTRIES = 2**22
"""Largest number of values μ_k(i)(x) ± R_i that are computed at once; a batch is divided accordingly."""
SAMPLES = 1000
"""Number of samples from which the median of a density is estimated, if the density gives no better way."""


def cross_validation_interval(
    centres: Float[Tensor, "batch part"],
    residuals: Float[Tensor, "sample"],
    parts: Int[Tensor, "sample"],
    miscoverage: float,
) -> tuple[Float[Tensor, "batch"], Float[Tensor, "batch"]]:
    """Return the ends of the CV+ interval of each input, float64 (Barber et al. 2021, jackknife+ and CV+).

    Of the n numbers μ_k(i)(x) - R_i, the lower end is the ⌊α (n + 1)⌋-th smallest. Of the n numbers μ_k(i)(x) + R_i,
    the upper end is the ⌈(1 - α)(n + 1)⌉-th smallest. With as many parts as samples this is the jackknife+. The ends
    are infinite if n is below 1/α - 1.

    Args:
        centres: μ_k(x), the point predictions of each input by the models that left out part k.
        residuals: R_i = |y_i - μ_k(i)(x_i)| of each sample, by the models that left out its part k(i).
        parts: k(i), the part of each sample.
        miscoverage: α.
    """
    # α is rounded, so that α (n + 1) may fall just below an integer; the factor corrects that
    rank = math.floor((len(residuals) + 1) * miscoverage * (1 + 1e-12))
    if rank < 1:
        infinite = centres.new_full((len(centres),), math.inf, dtype=torch.float64)
        return -infinite, infinite
    rank = min(rank, len(residuals))
    lows, highs = [], []
    for some in centres.double().split(max(1, ENTRIES // len(residuals))):
        own = some[:, parts]
        lows.append((own - residuals).kthvalue(rank, 1).values)
        highs.append((own + residuals).kthvalue(len(residuals) + 1 - rank, 1).values)
    return torch.cat(lows), torch.cat(highs)


@torch.no_grad()
def centres_of_parts(model: Predictor, wrapper: SelfTraining, inputs: Tensor) -> Float[Tensor, "batch part"]:
    """Return the median of each input's density by the models that left out each part, float64."""
    medians = []
    for part in range(wrapper.part_count):
        with leaving_out(wrapper, part):
            medians.append(median(model(inputs), SAMPLES).double().squeeze(-1))
    return torch.stack(medians, -1)


@contextmanager
def leaving_out(wrapper: SelfTraining, part: int) -> Iterator[None]:
    """Inside the block, let `wrapper` predict all samples by the models that left out this part in training."""
    wrapper.left_out = part
    try:
        yield
    finally:
        wrapper.left_out = None


class IntervalSet(Unchanged, ValueSet):
    """A density of one real number, unchanged to the last bit, and an interval for each item of the batch.

    Args:
        density: any density of one real number.
        low, high: ends of the interval, (*batch), float64; the interval is empty if low > high.
        stated_probability: probability with which the interval is stated to hold the target.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    def __init__(
        self,
        density: Distribution,
        low: Float[Tensor, "*batch"],
        high: Float[Tensor, "*batch"],
        stated_probability: float,
    ) -> None:
        super().__init__(density)
        self.low, self.high = low, high
        self.stated_probability = stated_probability

    def contains(self, value: Tensor) -> Bool[Tensor, "*shape"]:
        """Return whether each value (*sample, *batch, 1) is in the interval of its batch element."""
        number = value.double().squeeze(-1)
        return (self.low <= number) & (number <= self.high)

    def size(self) -> Float[Tensor, "*batch"]:
        """Return the length of each interval, float64."""
        return (self.high - self.low).clamp(min=0)

    def empty(self) -> Bool[Tensor, "*batch"]:
        """Return whether each interval is empty."""
        return self.low > self.high

    def intervals(self) -> list[list[tuple[float, float]]]:
        """Return one list for each item of the flattened batch: its interval (low, high), or nothing if it is empty."""
        pairs = zip(self.low.flatten().tolist(), self.high.flatten().tolist(), strict=True)
        return [[pair] if pair[0] <= pair[1] else [] for pair in pairs]

    def parts(self) -> list[list[tuple[float, float]]]:
        """Return one list for each item of the flattened batch, the same as `intervals` does."""
        return self.intervals()


@marginal.register
def _(density: IntervalSet, index: int) -> Distribution:
    return density if index == 0 else marginal(density.density, index)


@exported.register
def _(density: IntervalSet) -> Exported:
    raise ConfigError(
        "Intervals of score=cv_plus cannot be exported, because they need the predictions of all models. "
        "Calibrate the model with score=density, or use framework.load for this model."
    )
