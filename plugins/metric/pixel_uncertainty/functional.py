"""Of the numbers of an image: central intervals that hold them, and ranks of errors against predicted scales."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.protocol import each_cdf
from framework.errors import UserError


class Transform(NamedTuple):
    """F just below each stored number and just above it, (*batch, *event), float64: its probability integral transform
    is any number between the two."""

    low: Tensor
    high: Tensor


def transform(density: Distribution, value: Tensor, steps: int) -> Transform:
    """A stored number stands for all that are rounded to it: half a step to either side, at 0 and 1 all beyond.

    Args:
        value: (*batch, *event), in [0, 1].
        steps: between 0 and 1; 0: nothing was rounded.

    Raises:
        UserError: the density knows no distribution function of each number.
    """
    value = value.double()
    half = 0.5 / steps if steps else 0.0
    low, high = (each_cdf(density, value + side) for side in (-half, half))
    if low is None or high is None:
        raise UserError(
            f"{type(density).__name__} over {tuple(density.event_shape)} knows no distribution function of each of its "
            "numbers. Register one with `framework.distributions.protocol.each_cdf.register`, or leave out this metric."
        )
    if steps:
        low, high = low.masked_fill(value < half, 0.0), high.masked_fill(value > 1 - half, 1.0)
    return Transform(low, high)


def coverage(found: Transform, levels: Float[Tensor, "level"]) -> Float[Tensor, "level"]:
    """Share of the numbers in their central intervals of each mass; NaN of no number.

    A number counts with the probability that one drawn evenly between `low` and `high` lies in the interval of
    transforms (1 ± level) / 2: then nothing need be drawn (the nonrandomized transform of Czado, Gneiting & Held 2009,
    eq. 2), and where densities are those of the truth before it was rounded the share is the level.
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
    """Spearman's: Pearson's correlation of the ranks, ties sharing their mean; NaN where either is constant."""
    first, second = (part - part.mean() for part in (ranks(one), ranks(other)))
    return (first * second).sum() / (first.square().sum() * second.square().sum()).sqrt()


def ranks(values: Float[Tensor, "count"]) -> Float[Tensor, "count"]:
    """From 1, float64; equal values have the mean of theirs."""
    _, place, count = values.unique(return_inverse=True, return_counts=True)
    return (count.cumsum(0) - (count - 1).double() / 2)[place]
