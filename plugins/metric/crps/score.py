"""Continuous ranked probability score of densities of one real or one angle; a density may register its own formula."""

import math
from functools import singledispatch
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular, angular_distance, wrap
from framework.distributions.circular_moments import circular_moments
from framework.distributions.density import CHUNK
from framework.distributions.protocol import Normals, normals

MOST = 1024
"""Largest number of components of a mixture of normals whose pairs are summed; beyond it, draws are cheaper."""
REPLICATES = 8
"""Number of independent parts of the draws, from whose spread the error of an estimate is taken."""


class Score(NamedTuple):
    """Score of each item, (*batch), float64, in the unit of the target (angles: radians).

    Attributes:
        mean: the score.
        error: its standard error by sampling; 0 if the score is exact.
    """

    mean: Tensor
    error: Tensor


@singledispatch
def crps(density: Distribution, value: Tensor, samples: int) -> Score:
    """Return E|X - y| - ½ E|X - X'| (Gneiting & Raftery 2007, eq. 21); 0 is best, |X - y| for a point mass.

    For an angle the distance is the angular one (Grimit, Gneiting, Berrocal & Johnson 2006, eq. 5). The score is exact
    for mixtures of up to MOST normals and for angles that a grid resolves (`circular_moments`). Otherwise it is the
    fair (unbiased) estimate from `samples` draws, in `REPLICATES` parts whose spread gives its error.

    Args:
        density: density of one real or one angle, event_shape (1,).
        value: (*batch, 1).
        samples: number of draws, 2 · REPLICATES or more.
    """
    at = value.double().squeeze(-1)
    if isinstance(density.support, Circular):
        seen = circular_moments(density)
        exact = (seen.distance(at) - seen.spread / 2).clamp(min=0)
        if bool(seen.resolved.all()):
            return Score(exact, torch.zeros_like(exact))
        drawn = fair(_draws(density, samples), at, circular=True)
        return Score(*(torch.where(seen.resolved, a, b) for a, b in zip((exact, 0.0), drawn, strict=True)))
    known = normals(density)
    if known is not None and known.mean.shape[-1] <= MOST:
        exact = of_normals(known, at)
        return Score(exact, torch.zeros_like(exact))
    return fair(_draws(density, samples), at, circular=False)


def _draws(density: Distribution, samples: int) -> Tensor:
    return density.sample(torch.Size((samples,))).double().squeeze(-1)


def of_normals(density: Normals, value: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return the score of a mixture of K normals in closed form (Grimit et al. 2006, eq. 8), in O(K²)."""
    weights = density.log_weights.exp()
    to_value = _weighted(weights, absolute_mean(value.unsqueeze(-1) - density.mean, density.scale)).sum(-1)
    if density.mean.shape[-1] == 1:
        # E|X - X'| = 2σ/√π in closed form, so that a large mean costs no digits
        return (to_value - density.scale.squeeze(-1) / math.sqrt(math.pi)).clamp(min=0)
    count = density.mean.shape[-1]
    rows = [number.flatten(0, -2) for number in (weights, density.mean, density.scale)]
    step = max(1, CHUNK // count**2)
    parts = [_between(*part) for part in zip(*(row.split(step) for row in rows), strict=True)]
    return (to_value - torch.cat(parts).reshape(to_value.shape) / 2).clamp(min=0)


def _between(weights: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
    """Return ΣΣ w_i w_j E|X_i - X_j|; each argument is (rows, component)."""
    apart = mean.unsqueeze(-1) - mean.unsqueeze(-2)
    both = torch.hypot(scale.unsqueeze(-1), scale.unsqueeze(-2))
    pairs = weights.unsqueeze(-1) * weights.unsqueeze(-2)
    return _weighted(pairs, absolute_mean(apart, both)).sum((-2, -1))


def _weighted(weights: Tensor, numbers: Tensor) -> Tensor:
    """Return weights · numbers, with 0 where the weight is 0, even if the number is infinite or NaN."""
    return torch.where(weights == 0, 0.0, weights * numbers)


def absolute_mean(mean: Tensor, scale: Tensor) -> Tensor:
    """Return E|Z| for Z ~ N(μ, σ²): 2σφ(μ/σ) + μ(2Φ(μ/σ) - 1) (Grimit et al. 2006, after eq. 8); |μ| where σ = 0."""
    standard = torch.where(mean == 0, mean, mean / scale)
    bell = torch.exp(-standard.square() / 2) * math.sqrt(2 / math.pi)
    return scale * bell + mean * torch.erf(standard / math.sqrt(2))


def fair(drawn: Float[Tensor, "samples *batch"], value: Float[Tensor, "*batch"], *, circular: bool) -> Score:
    """Return the mean of the unbiased estimates from REPLICATES parts of the draws, and its standard error."""
    size = len(drawn) // REPLICATES
    parts = drawn[: size * REPLICATES].unflatten(0, (REPLICATES, size)).transpose(0, 1)
    if circular:
        each = angular_distance(parts, value).mean(0) - mean_angular_distance(parts) / 2
    else:
        each = (parts - value).abs().mean(0) - mean_distance(parts) / 2
    return Score(each.mean(0), each.std(0) / math.sqrt(REPLICATES))


def mean_distance(drawn: Float[Tensor, "samples *batch"]) -> Float[Tensor, "*batch"]:
    """Return the mean distance over all pairs of reals, in O(S log S)."""
    count = len(drawn)
    ordered = (drawn - drawn[0]).sort(0).values  # relative to one draw, so that a large mean costs no digits
    # Σ_{i<j} (x_j - x_i): the i-th is subtracted S-1-i times and added i times
    factor = 2 * torch.arange(count, dtype=drawn.dtype, device=drawn.device) - (count - 1)
    total = (factor.reshape(-1, *(1,) * (drawn.dim() - 1)) * ordered).sum(0)
    return total * 2 / (count * (count - 1))


def mean_angular_distance(drawn: Float[Tensor, "samples *batch"]) -> Float[Tensor, "*batch"]:
    """Return the mean angular distance over all pairs of angles, radians, in O(S log S).

    The distance of two angles is the measure of the diameters, at t in [0, π), that separate them. If n(t) angles are
    on one side of a diameter, n (S - n) pairs are separated, and n changes by one at each angle modulo π.
    """
    count = len(drawn)
    angle = wrap(drawn)
    place, order = torch.remainder(angle, math.pi).sort(0)
    upper = (angle >= 0).gather(0, order)  # on the side (t, t + π) of the diameter at t = 0
    # passing an angle of that side removes it from the side; passing an antipode adds one
    side = upper.sum(0) + torch.where(upper, -1, 1).cumsum(0)
    gap = torch.cat([place[1:], place[:1] + math.pi]) - place
    return (side * (count - side) * gap).sum(0) * 2 / (count * (count - 1))
