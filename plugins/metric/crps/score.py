"""Continuous ranked probability score of one real number or one angle; a density may register its own formula."""

import math
from functools import singledispatch
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions import protocol
from framework.distributions.circular import Circular, angular_distance, wrap
from framework.distributions.circular_moments import circular_moments
from framework.distributions.density import CHUNK
from framework.distributions.protocol import Normals, normals

MOST = 1024
"""Largest number of components of a mixture of normals for which all pairs are summed; for more, draws are cheaper."""
REPLICATES = 8
"""Number of independent parts of the draws; their spread gives the error of an estimate."""


class Score(NamedTuple):
    """Score of each item, (*batch), float64, in the unit of the target (angles: radians).

    Attributes:
        mean: the score.
        error: standard error of a score that is estimated from draws; 0 if the score is exact.
    """

    mean: Tensor
    error: Tensor


@singledispatch
def crps(density: Distribution, value: Tensor, samples: int) -> Score:
    """Return the score E|X - y| - ½ E|X - X'| (Gneiting & Raftery 2007, eq. 21); lower is better, 0 is best.

    X and X' are independent samples of the density, and y is `value`. For an angle, |·| is the angular distance
    (Grimit, Gneiting, Berrocal & Johnson 2006, eq. 5). The score is exact for densities that register a formula
    (`protocol.ranked_score`), for mixtures of up to `MOST` normals, and for angles whose density a grid resolves
    (`circular_moments`). Otherwise the score is estimated without bias from `samples` draws, in `REPLICATES` parts
    whose spread gives the error.

    Args:
        density: density of one real number or one angle, event_shape (1,).
        value: (*batch, 1).
        samples: number of draws, at least 2 · REPLICATES.
    """
    at = value.double().squeeze(-1)
    if isinstance(density.support, Circular):
        moments = circular_moments(density)
        exact = (moments.distance(at) - moments.spread / 2).clamp(min=0)
        if bool(moments.resolved.all()):
            return Score(exact, torch.zeros_like(exact))
        draws = fair_estimate(_draws(density, samples), at, circular=True)
        return Score(*(torch.where(moments.resolved, a, b) for a, b in zip((exact, 0.0), draws, strict=True)))
    formula = protocol.ranked_score(density, value)
    if formula is not None:
        return Score(formula, torch.zeros_like(formula))
    known = normals(density)
    if known is not None and known.mean.shape[-1] <= MOST:
        exact = normal_mixture_score(known, at)
        return Score(exact, torch.zeros_like(exact))
    return fair_estimate(_draws(density, samples), at, circular=False)


def _draws(density: Distribution, samples: int) -> Tensor:
    return density.sample(torch.Size((samples,))).double().squeeze(-1)


def normal_mixture_score(density: Normals, value: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return the score of a mixture of K normals by its formula (Grimit et al. 2006, eq. 8), with O(K²) operations."""
    weights = density.log_weights.exp()
    to_value = _weighted(weights, absolute_mean(value.unsqueeze(-1) - density.mean, density.scale)).sum(-1)
    if density.mean.shape[-1] == 1:
        # E|X - X'| = 2σ/√π in closed form, which keeps all digits for a large mean
        return (to_value - density.scale.squeeze(-1) / math.sqrt(math.pi)).clamp(min=0)
    count = density.mean.shape[-1]
    rows = [number.flatten(0, -2) for number in (weights, density.mean, density.scale)]
    step = max(1, CHUNK // count**2)
    parts = [_between(*part) for part in zip(*(row.split(step) for row in rows), strict=True)]
    return (to_value - torch.cat(parts).reshape(to_value.shape) / 2).clamp(min=0)


def _between(weights: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
    """Return Σ_i Σ_j w_i w_j E|X_i - X_j| for independent X_i ~ N(`mean`_i, `scale`_i²) with the weights w_i.

    Each argument is (rows, component), and the sums are over the components.
    """
    difference = mean.unsqueeze(-1) - mean.unsqueeze(-2)
    both = torch.hypot(scale.unsqueeze(-1), scale.unsqueeze(-2))
    pairs = weights.unsqueeze(-1) * weights.unsqueeze(-2)
    return _weighted(pairs, absolute_mean(difference, both)).sum((-2, -1))


def _weighted(weights: Tensor, numbers: Tensor) -> Tensor:
    """Return weights · numbers, with 0 where the weight is 0, even if the number is infinite or NaN."""
    return torch.where(weights == 0, 0.0, weights * numbers)


def absolute_mean(mean: Tensor, scale: Tensor) -> Tensor:
    """Return E|Z| for Z ~ N(μ, σ²), with μ in `mean` and σ in `scale`.

    It is 2σφ(μ/σ) + μ(2Φ(μ/σ) - 1) with the standard normal density φ and distribution function Φ (Grimit et al. 2006,
    after eq. 8), and |μ| if σ = 0.
    """
    standard = torch.where(mean == 0, mean, mean / scale)
    bell = torch.exp(-standard.square() / 2) * math.sqrt(2 / math.pi)
    return scale * bell + mean * torch.erf(standard / math.sqrt(2))


def fair_estimate(
    draws: Float[Tensor, "samples *batch"], value: Float[Tensor, "*batch"], *, circular: bool
) -> Score:
    """Return the score that is estimated without bias from draws of the density, and its standard error.

    The estimate is the mean of the estimates from `REPLICATES` parts of the draws. `circular` is true for an angle.
    """
    size = len(draws) // REPLICATES
    parts = draws[: size * REPLICATES].unflatten(0, (REPLICATES, size)).transpose(0, 1)
    if circular:
        estimates = angular_distance(parts, value).mean(0) - mean_angular_distance(parts) / 2
    else:
        estimates = (parts - value).abs().mean(0) - mean_distance(parts) / 2
    return Score(estimates.mean(0), estimates.std(0) / math.sqrt(REPLICATES))


def mean_distance(draws: Float[Tensor, "samples *batch"]) -> Float[Tensor, "*batch"]:
    """Return the mean distance over all pairs of S real numbers, in O(S log S)."""
    count = len(draws)
    # relative to one draw, which keeps all digits for a large mean
    ordered = (draws - draws[0]).sort(0).values
    # Σ_{i<j} (x_j - x_i): the i-th is subtracted S-1-i times and added i times
    factor = 2 * torch.arange(count, dtype=draws.dtype, device=draws.device) - (count - 1)
    total = (factor.reshape(-1, *(1,) * (draws.dim() - 1)) * ordered).sum(0)
    return total * 2 / (count * (count - 1))


def mean_angular_distance(draws: Float[Tensor, "samples *batch"]) -> Float[Tensor, "*batch"]:
    """Return the mean angular distance over all pairs of S angles, radians, in O(S log S).

    A diameter of the circle at the angle t separates two angles if they lie on different sides of it. The angular
    distance of two angles is the measure of all t in [0, π) at which the diameter separates them. If n(t) angles are on
    one side of the diameter, it separates n (S - n) pairs. n(t) changes by one at each angle modulo π.
    """
    count = len(draws)
    angle = wrap(draws)
    position, order = torch.remainder(angle, math.pi).sort(0)
    upper = (angle >= 0).gather(0, order)  # on the side (t, t + π) of the diameter at t = 0
    # at an angle of this side the count decreases by one; at the antipode of another angle it increases by one
    side = upper.sum(0) + torch.where(upper, -1, 1).cumsum(0)
    gap = torch.cat([position[1:], position[:1] + math.pi]) - position
    return (side * (count - side) * gap).sum(0) * 2 / (count * (count - 1))
