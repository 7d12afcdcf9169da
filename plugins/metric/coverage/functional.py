"""The highest-density region that a target lies on the border of, and the size of the one with a given mass."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular
from framework.distributions.circular_moments import CircularMoments, circular_moments
from framework.distributions.class_probabilities import class_probabilities, require_labels
from framework.distributions.protocol import mahalanobis, normals

EQUAL = {torch.float32: 1e-6, torch.float64: 1e-12}
"""Densities that differ by a smaller part are equally dense, by their number type: rounding must not decide on a
plateau."""
FINER = 8
"""Angles on which regions are cut out, for each one at which the density is evaluated."""
BLOCK = 2**18
"""Angles cut out at once: enough that calls cost little, and few enough for a cache."""
HALVINGS = 40
"""Of a cell in which a border lies: to its 1e-12th part."""
SECANTS = 2
"""Steps to the level of a region with a given mass, from one that the grid brackets to some ten per cent."""


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
        found = of_angle(seen, density.log_prob(value), mass)
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
    equal = EQUAL[torch.float32]
    low = _sum_where(probability > at * (1 + equal), probability)
    high = _sum_where(probability >= at * (1 - equal), probability)
    return Border(low, high, _counted(probability, mass))


def of_angle(seen: CircularMoments, log_prob: Float[Tensor, "batch"], mass: float) -> Border:
    """On a grid finer than the moments', between whose points the density is a cubic with its values and slopes."""
    rows = max(1, BLOCK // (2 * FINER * len(seen.moments)))
    parts = zip(seen.moments.split(rows, 1), seen.resolved.split(rows), log_prob.split(rows), strict=True)
    found = [_of_angle(CircularMoments(moments, known), at, mass) for moments, known, at in parts]
    return Border(*(torch.cat(numbers) for numbers in zip(*found, strict=True)))


def _of_angle(seen: CircularMoments, log_prob: Float[Tensor, "batch"], mass: float) -> Border:
    cubic = Cubic.of(seen)
    level, equal = log_prob.double().exp(), EQUAL[log_prob.dtype]
    low, _ = cubic.above(level)
    high = low.clone()
    # a plateau, or a mode, on which rounding would decide
    flat = ((cubic.density - level).abs() <= equal * level).any(0) | (level >= cubic.density.amax(0))
    if bool(flat.any()):
        here = cubic.rows(flat)
        low[flat], high[flat] = (here.above(level[flat] * factor)[0] for factor in (1 + equal, 1 - equal))
    missing = log_prob.isnan() | seen.moments[0].isnan()
    found = (low.clamp(0, 1), high.clamp(0, 1), cubic.size(mass))
    return Border(*(torch.where(missing, torch.nan, number) for number in found))


class Cubic(NamedTuple):
    """The density on the circle as a cubic in each cell of a grid (Hermite's), which has an error of the cell's fourth
    power.

    Attributes:
        density: at the grid's points, (point, batch), per radian.
        slope: its change over a cell if it went on as at the point.
    """

    density: Float[Tensor, "point batch"]
    slope: Float[Tensor, "point batch"]

    @classmethod
    def of(cls, seen: CircularMoments) -> "Cubic":
        density = seen.density(FINER)
        return cls(density, seen.density(FINER, slope=True) * (2 * math.pi / len(density)))

    def rows(self, chosen: Tensor) -> "Cubic":
        """Those of some items of the batch."""
        return Cubic(self.density[:, chosen], self.slope[:, chosen])

    def above(self, level: Float[Tensor, "batch"]) -> tuple[Float[Tensor, "batch"], Float[Tensor, "batch"]]:
        """Mass where the density is at least the level, and the length of that region, radians."""
        left, right = self.density, self.density.roll(-1, 0)
        rise, fall = self.slope, self.slope.roll(-1, 0)
        first, second = left >= level, right >= level
        whole = first & second
        mass = torch.where(whole, (left + right) / 2 + (rise - fall) / 12, 0.0).sum(0)
        length = whole.sum(0).double()
        # cells with one border, and those whose top or bottom may be beyond the level though neither end is
        for chosen, turning in (
            (first ^ second, False),
            ((rise > 0) & (fall < 0) & ~first & ~second, True),
            ((rise < 0) & (fall > 0) & whole, True),
        ):
            cell, item = chosen.nonzero(as_tuple=True)
            if len(cell) == 0:
                continue
            ends = torch.stack([table[cell, item] for table in (left, right, rise, fall)])
            more, longer = _part(ends, level[item], turning=turning)
            mass.index_add_(0, item, more)
            length.index_add_(0, item, longer)
        step = 2 * math.pi / len(self.density)
        return mass * step, length * step

    def size(self, mass: float) -> Float[Tensor, "batch"]:
        """Length of the region of highest density with a mass, radians.

        The level is interpolated between two that the grid's points suggest, and those are drawn together. What mass
        is then missing is divided by the level: as it falls, mass grows by the level times what the length grows by.
        """
        step = 2 * math.pi / len(self.density)
        ordered = self.density.clamp(min=0).sort(0, descending=True).values
        kept = ((ordered.cumsum(0) * step) < mass).sum(0, keepdim=True).clamp(max=len(ordered) - 1)
        lowest = torch.finfo(torch.float64).tiny
        high, low = (
            ordered.gather(0, (kept + places).clamp(0, len(ordered) - 1)).squeeze(0).clamp(min=lowest)
            for places in (-4, 4)
        )
        more, less = self.above(low)[0], self.above(high)[0]
        level, found, length = high, less, torch.zeros_like(less)
        for _ in range(SECANTS):
            share = torch.where(more > less, (mass - less) / (more - less), 0.0).clamp(0, 1)
            level = high + share * (low - high)
            found, length = self.above(level)
            enough = found >= mass
            low, more = torch.where(enough, level, low), torch.where(enough, found, more)
            high, less = torch.where(enough, high, level), torch.where(enough, less, found)
        return length + (mass - found) / level


def _part(
    ends: Float[Tensor, "4 cell"], level: Float[Tensor, "cell"], *, turning: bool
) -> tuple[Float[Tensor, "cell"], Float[Tensor, "cell"]]:
    """Of cells with a border what mass and length, in cells, lie above the level, beyond what is counted already.

    Args:
        ends: density left and right, slopes left and right.
        turning: whether the border, if there is one, is on both sides of a turning point; else there is one.
    """
    left, right, rise, fall = ends
    square, cube = 3 * (right - left) - 2 * rise - fall, 2 * (left - right) + rise + fall

    def height(at: Tensor) -> Tensor:
        return left + at * (rise + at * (square + at * cube)) - level

    def until(at: Tensor) -> Tensor:
        return at * (left + at * (rise / 2 + at * (square / 3 + at * cube / 4)))

    zero, one = torch.zeros_like(left), torch.ones_like(left)
    if not turning:
        border = _root(height, zero, one)
        falling = left >= level
        mass = torch.where(falling, until(border), until(one) - until(border))
        return mass, torch.where(falling, border, 1 - border)
    top = _root(lambda at: rise + at * (2 * square + 3 * at * cube), zero, one)
    before, after = _root(height, zero, top), _root(height, top, one)
    beyond = height(top).sign() != height(zero).sign()
    # a hump is added; a dip, whose cell was counted whole, is taken off again
    sign = torch.where(beyond, -height(zero).sign(), 0.0)
    return sign * (until(after) - until(before)), sign * (after - before)


def _root(function: Callable[[Tensor], Tensor], low: Tensor, high: Tensor) -> Tensor:
    """Where a function changes its sign, by halving; anywhere between where it does not."""
    start = function(low).sign()
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        same = function(middle).sign() == start
        low, high = torch.where(same, middle, low), torch.where(same, high, middle)
    return (low + high) / 2


def of_draws(density: Distribution, value: Tensor, mass: float, samples: int) -> Border:
    """By the target's rank in density among draws; the size of one number's region as E[1{p(X) ≥ t} / p(X)]."""
    drawn = density.sample(torch.Size((samples,)))
    log_prob, at = density.log_prob(drawn).double(), density.log_prob(value).double()
    equal = EQUAL[torch.float32]
    low = (log_prob > at + equal).double().sum(0) / (samples + 1)
    high = ((log_prob >= at - equal).double().sum(0) + 1) / (samples + 1)
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
