"""Coverage of central intervals of the values of an image, and rank correlation of errors with predicted scales."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.protocol import marginal_cdfs
from framework.errors import UserError


class Transform(NamedTuple):
    """Distribution function at both ends of the interval of numbers that are rounded to a stored value.

    `low` and `high` are (*batch, *event), float64. The probability integral transform of the number before it was
    rounded lies between them.
    """

    low: Tensor
    high: Tensor


def transform(density: Distribution, value: Tensor, steps: int) -> Transform:
    """Return the distribution function at both ends of the interval of numbers that are rounded to each stored value.

    A stored value stands for all values that are rounded to it: half a step to either side; a stored 0 also stands for
    all values below 0, and a stored 1 for all values above 1.

    Args:
        density: density whose distribution function is known for each value.
        value: (*batch, *event), in [0, 1].
        steps: number of steps between the stored values 0 and 1; 0 if nothing was rounded.

    Raises:
        UserError: the density has no distribution function for each value.
    """
    value = value.double()
    half = 0.5 / steps if steps else 0.0
    low, high = (marginal_cdfs(density, value + side) for side in (-half, half))
    if low is None or high is None:
        raise UserError(
            f"{type(density).__name__} over {tuple(density.event_shape)} has no distribution function for each of its "
            "values. Register one with `framework.distributions.protocol.marginal_cdfs.register`, or leave this "
            "metric out."
        )
    if steps:
        low, high = low.masked_fill(value < half, 0.0), high.masked_fill(value > 1 - half, 1.0)
    return Transform(low, high)


def coverage(transforms: Transform, levels: Float[Tensor, "level"]) -> Float[Tensor, "level"]:
    """Return the share of the values that lie in their central intervals of each mass; NaN without values.

    The levels are the masses of the intervals. A value counts with the probability that a number drawn uniformly
    between `low` and `high` of its transform lies between (1 - level) / 2 and (1 + level) / 2. This needs no random
    numbers (nonrandomized transform of Czado, Gneiting & Held 2009, eq. 2). The expected share equals the level if the
    densities are correct for the true values before rounding.
    """
    low, high = (part.flatten() for part in transforms)
    width = high - low
    shares = []
    for level in levels.tolist():
        first, last = (1 - level) / 2, (1 + level) / 2
        part = (high.clamp(max=last) - low.clamp(min=first)).clamp(min=0) / width
        point = ((low >= first) & (low <= last)).double()
        shares.append(torch.where(width > 0, part, point).mean())
    return torch.stack(shares)


def rank_correlation(first_values: Float[Tensor, "count"], second_values: Tensor) -> Float[Tensor, ""]:
    """Return Spearman's rank correlation; ties share their mean rank. NaN if all values of an argument are equal."""
    first, second = (part - part.mean() for part in (ranks(first_values), ranks(second_values)))
    return (first * second).sum() / (first.square().sum() * second.square().sum()).sqrt()


def ranks(values: Float[Tensor, "count"]) -> Float[Tensor, "count"]:
    """Return the ranks from 1, float64; equal values have the mean of their ranks."""
    _, place, count = values.unique(return_inverse=True, return_counts=True)
    return (count.cumsum(0) - (count - 1).double() / 2)[place]
