"""The highest-density region that a target lies on the border of, and the size of the one with a given mass."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import Distribution

from framework.circular_moments import CircularMoments, circular_moments
from framework.class_probabilities import class_probabilities, require_labels
from framework.density import Circular
from framework.normals import mahalanobis, normals

EQUAL = 1e-6
"""Densities that differ by a smaller part are equally dense: rounding must not decide on a plateau."""
FINER = 8
"""Angles on which regions are cut out, for each one at which the density is evaluated."""
SORTED = 4
"""The same where all angles are sorted."""
BLOCK = 2**16
"""Angles cut out at once: they stay in the cache."""


class Border(NamedTuple):
    """Of each item, (batch,), float64.

    Attributes:
        low, high: mass strictly denser than the target, and at least as dense. Where the truth is drawn from the
            density, a number drawn evenly between the two is uniform on [0, 1].
        size: of the region of highest density with the mass asked for: labels, radians or the unit of the real; NaN of
            several numbers.
    """

    low: Tensor
    high: Tensor
    size: Tensor


def border(density: Distribution, value: Tensor, mass: float, samples: int) -> Border:
    """Exact for classes, normals and an angle that a grid resolves; otherwise from `samples` draws.

    Among draws the target's rank is as random as they are, yet uniform where the density is the truth's.

    Args:
        density: batch_shape (batch,).
        value: (batch, *event).
        mass: of the region whose size is told, in (0, 1).
    """
    if density.has_enumerate_support:
        return of_classes(density, value, mass)
    one = tuple(density.event_shape) == (1,)
    if one and isinstance(density.support, Circular):
        seen = circular_moments(density)
        found = of_angle(seen, density.log_prob(value).double(), mass)
        if bool(seen.resolved.all()):
            return found
        drawn = of_draws(density, value, mass, samples)
        return Border(*(torch.where(seen.resolved, a, b) for a, b in zip(found, drawn, strict=True)))
    distance = mahalanobis(density, value)
    if distance is None:
        return of_draws(density, value, mass, samples)
    # the squared distance of a normal's own draws is χ² with as many degrees of freedom as numbers
    inside = torch.special.gammainc(torch.full_like(distance, density.event_shape[0] / 2), distance / 2)
    known = normals(density)
    if known is None:
        return Border(inside, inside, torch.full_like(inside, torch.nan))
    quantile = torch.special.ndtri(torch.tensor((1 + mass) / 2, dtype=torch.float64))
    return Border(inside, inside, 2 * quantile.to(inside) * known.scale.squeeze(-1))


def of_classes(density: Distribution, value: Int[Tensor, "batch"], mass: float) -> Border:
    """By enumeration; the size counts the last label as the part of it that is needed."""
    probability = class_probabilities(density).T
    at = probability.gather(0, require_labels(value.long(), len(probability)).unsqueeze(0))
    low = _sum_where(probability > at * (1 + EQUAL), probability)
    high = _sum_where(probability >= at * (1 - EQUAL), probability)
    return Border(low, high, _counted(probability, mass))


def of_angle(seen: CircularMoments, log_prob: Float[Tensor, "batch"], mass: float) -> Border:
    """On a grid finer than the moments', the density taken as straight between its points."""
    rows = max(1, BLOCK // (FINER * len(seen.moments)))
    parts = zip(seen.moments.split(rows, 1), seen.resolved.split(rows), log_prob.split(rows), strict=True)
    found = [_of_angle(CircularMoments(moments, known), at, mass) for moments, known, at in parts]
    return Border(*(torch.cat(numbers) for numbers in zip(*found, strict=True)))


def _of_angle(seen: CircularMoments, log_prob: Float[Tensor, "batch"], mass: float) -> Border:
    density = seen.density(FINER)
    step = 2 * math.pi / len(density)
    level = log_prob.exp()
    low = _above(density, level) * step
    high = low.clone()
    # a plateau, on which rounding would decide
    flat = ((density - level).abs_() <= EQUAL * level).any(0)
    if bool(flat.any()):
        here = density[:, flat]
        low[flat], high[flat] = (
            _above(here, level[flat] * factor) * step for factor in (1 + EQUAL, 1 - EQUAL)
        )
    cell = step * FINER / SORTED
    size = _counted(seen.density(SORTED).clamp_(min=0) * cell, mass) * cell
    missing = log_prob.isnan() | seen.moments[0].isnan()
    found = (low.clamp(0, 1), high.clamp(0, 1), size)
    return Border(*(torch.where(missing, torch.nan, number) for number in found))


def _above(density: Float[Tensor, "point batch"], level: Float[Tensor, "batch"]) -> Float[Tensor, "batch"]:
    """Sum over a grid around the circle of the mass where the density is at least the level, over the grid's step."""
    following = density.roll(-1, 0)
    most, least = torch.maximum(density, following), torch.minimum(density, following)
    # of each cell the part above the level; of one that is flat and at the level, 0/0, all
    share = ((most - level) / (most - least)).nan_to_num_(1.0, math.inf, -math.inf).clamp_(0, 1)
    return (share * most.add_(torch.maximum(least, level))).sum(0) / 2


def of_draws(density: Distribution, value: Tensor, mass: float, samples: int) -> Border:
    """By the target's rank in density among draws; the size of one number's region as E[1{p(X) ≥ t} / p(X)]."""
    drawn = density.sample(torch.Size((samples,)))
    log_prob, at = density.log_prob(drawn).double(), density.log_prob(value).double()
    low = (log_prob > at + EQUAL).double().sum(0) / (samples + 1)
    high = ((log_prob >= at - EQUAL).double().sum(0) + 1) / (samples + 1)
    size = torch.full_like(low, torch.nan)
    if tuple(density.event_shape) == (1,):
        kept = max(1, round(mass * samples))
        size = (-log_prob.sort(0, descending=True).values[:kept]).exp().sum(0) / samples
    missing = log_prob.isnan().any(0) | at.isnan()
    return Border(*(torch.where(missing, torch.nan, number) for number in (low, high, size)))


def _sum_where(chosen: Tensor, probability: Tensor) -> Tensor:
    return torch.where(chosen, probability, 0.0).sum(0).clamp(max=1)


def _counted(mass: Float[Tensor, "cell batch"], wanted: float) -> Float[Tensor, "batch"]:
    """How many cells, the heaviest first and the last one in part, hold a mass."""
    ordered = mass.sort(0, descending=True).values
    before = ordered.cumsum(0) - ordered
    share = torch.where(ordered > 0, (wanted - before) / ordered, 0.0)
    return share.clamp(0, 1).sum(0)


def covered(low: Tensor, high: Tensor, levels: Float[Tensor, "level"]) -> Float[Tensor, "batch level"]:
    """Probability that a number drawn evenly between low and high is at most each level.

    So nothing need be drawn to break ties (the nonrandomized transform of Czado, Gneiting & Held 2009, eq. 2).
    """
    low, high = low.unsqueeze(-1), high.unsqueeze(-1)
    width = high - low
    inside = torch.where(width > 0, ((levels - low) / width).clamp(0, 1), (low <= levels).double())
    return torch.where(width.isnan(), torch.nan, inside)
