"""Coverage of central intervals of an image's numbers, and rank correlation of errors with predicted scales."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.protocol import marginal_cdfs
from framework.errors import UserError


class Transform(NamedTuple):
    """F just below and just above each stored number, (*batch, *event), float64.

    The probability integral transform of a rounded number is any number between the two.
    """

    low: Tensor
    high: Tensor


def transform(density: Distribution, value: Tensor, steps: int) -> Transform:
    """Return the distribution function at both ends of the interval that is rounded to each stored number.

    A stored number stands for all numbers that are rounded to it: half a step to either side, and everything beyond at
    0 and 1.

    Args:
        density: a density whose distribution function is known for each number.
        value: (*batch, *event), in [0, 1].
        steps: number of steps of the stored numbers between 0 and 1; 0 if nothing was rounded.

    Raises:
        UserError: the density knows no distribution function of each number.
    """
    value = value.double()
    half = 0.5 / steps if steps else 0.0
    low, high = (marginal_cdfs(density, value + side) for side in (-half, half))
    if low is None or high is None:
        raise UserError(
            f"{type(density).__name__} over {tuple(density.event_shape)} knows no distribution function of each of its "
            "numbers. Register one with `framework.distributions.protocol.marginal_cdfs.register`, or leave out "
            "this metric."
        )
    if steps:
        low, high = low.masked_fill(value < half, 0.0), high.masked_fill(value > 1 - half, 1.0)
    return Transform(low, high)


def coverage(found: Transform, levels: Float[Tensor, "level"]) -> Float[Tensor, "level"]:
    """Return the share of the numbers in their central intervals of each mass; NaN without numbers.

    A number counts with the probability that a number drawn uniformly between `low` and `high` lies in the interval of
    transforms (1 ± level) / 2. Nothing need be drawn (the nonrandomized transform of Czado, Gneiting & Held 2009, eq.
    2), and where the densities are those of the truth before it was rounded, the share is the level.
    """
    low, high = (part.flatten() for part in found)
    width = high - low
    shares = []
    for level in levels.tolist():
        first, last = (1 - level) / 2, (1 + level) / 2
        part = (high.clamp(max=last) - low.clamp(min=first)).clamp(min=0) / width
        point = ((low >= first) & (low <= last)).double()
        shares.append(torch.where(width > 0, part, point).mean())
    return torch.stack(shares)


def rank_correlation(one: Float[Tensor, "count"], other: Tensor) -> Float[Tensor, ""]:
    """Return Spearman's correlation: Pearson's of the ranks, ties sharing their mean; NaN where one is constant."""
    first, second = (part - part.mean() for part in (ranks(one), ranks(other)))
    return (first * second).sum() / (first.square().sum() * second.square().sum()).sqrt()


def ranks(values: Float[Tensor, "count"]) -> Float[Tensor, "count"]:
    """Return the ranks from 1, float64; equal values have the mean of their ranks."""
    _, place, count = values.unique(return_inverse=True, return_counts=True)
    return (count.cumsum(0) - (count - 1).double() / 2)[place]
