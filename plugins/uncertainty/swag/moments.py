"""Running mean, variance and last deviations of weights, and draws from their Gaussian (Maddox et al. 2019)."""

import math
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor


class Moments(NamedTuple):
    """Moments of the weights of several epochs; `add` changes them in place.

    Attributes:
        count: number of epochs, int64, 0-dimensional.
        mean: mean of the weights, (weight,).
        squares: sum of the squared deviations from the mean, (weight,).
        deviations: deviations of the last epochs from the mean at that time, (rank, weight). Epoch i, from 0, is in row
            i modulo rank.
    """

    count: Tensor
    mean: Tensor
    squares: Tensor
    deviations: Tensor


def add(moments: Moments, weights: Float[Tensor, "weight"]) -> None:
    """Add the weights of an epoch in place (Welford 1962, which rounds less than differences of squares)."""
    step = weights - moments.mean
    moments.count.add_(1)
    moments.mean.add_(step / moments.count)
    moments.squares.add_(step * (weights - moments.mean))
    if len(moments.deviations):
        row = (int(moments.count) - 1) % len(moments.deviations)
        moments.deviations[row] = weights - moments.mean


def draw(moments: Moments, noise: Float[Tensor, "number"]) -> Float[Tensor, "weight"]:
    """Return weights drawn from the Gaussian N(mean, Σ/2 + D Dᵀ / (2 (K - 1))) (Maddox et al. 2019, eq. 1).

    Σ is the diagonal matrix of the variances of the weights, and D has the last K deviations as columns. With
    fewer than two deviations the draw is from N(mean, Σ).

    Args:
        moments: moments of at least one epoch.
        noise: standard normal numbers: one for each weight, then one for each row of `deviations`.
    """
    variance = moments.squares.clamp(min=0) / moments.count
    size = len(moments.mean)
    used = min(int(moments.count), len(moments.deviations))
    if used < 2:
        return moments.mean + variance.sqrt() * noise[:size]
    low_rank = noise[size : size + used] @ moments.deviations[:used]
    return moments.mean + (variance / 2).sqrt() * noise[:size] + low_rank / math.sqrt(2 * (used - 1))
