"""Highest-density region with the target on its border, and size of the highest-density region of a given mass."""

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
"""Relative difference below which densities count as equal, by number type; rounding must not decide on a plateau."""
FINER = 8
"""Number of angles on which regions are cut out, per angle at which the density is evaluated."""
BLOCK = 2**18
"""Number of angles that are processed at once: large enough to make calls cheap, small enough for a cache."""
HALVINGS = 40
"""Bisection steps within the cell in which a border lies; they locate it to 1e-12 of the cell."""
SECANTS = 2
"""Secant steps to the level of a region of a given mass; the grid brackets the level to some ten per cent."""


class Border(NamedTuple):
    """Masses and size of highest-density regions, one for each item, (batch,), float64.

    Attributes:
        low, high: mass that is strictly denser than the target, and mass that is at least as dense. Where the truth is
            drawn from the density, a number drawn uniformly between the two is uniform on [0, 1].
        size: size of the highest-density region with the given mass, in labels, radians or the unit of the real; NaN
            for a target of several numbers.
    """

    low: Tensor
    high: Tensor
    size: Tensor


def border(density: Distribution, value: Tensor, mass: float, samples: int) -> Border:
    """Return the masses and the size of highest-density regions.

    The result is exact for classes, for normals, and for an angle that a grid resolves; otherwise it is estimated from
    `samples` draws. The target's rank among draws is as random as the draws are; still it is uniform where the density
    is the true one.

    Args:
        density: batch_shape (batch,).
        value: (batch, *event).
        mass: mass of the region whose size is returned, in (0, 1).
        samples: number of draws.
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
    # the squared Mahalanobis distance of draws of a normal is χ² with one degree of freedom for each number
    inside = torch.special.gammainc(torch.full_like(distance, density.event_shape[0] / 2), distance / 2)
    known = normals(density)
    if known is None:
        return Border(inside, inside, torch.full_like(inside, torch.nan))
    quantile = torch.special.ndtri(torch.tensor((1 + mass) / 2, dtype=torch.float64))
    return Border(inside, inside, 2 * quantile.to(inside) * known.scale.squeeze(-1))


def of_classes(density: Distribution, value: Int[Tensor, "batch"], mass: float) -> Border:
    """Return the result for classes by enumeration; the last label counts in the size only by its needed part."""
    probability = class_probabilities(density).T
    at = probability.gather(0, require_labels(value.long(), len(probability)).unsqueeze(0))
    equal = EQUAL[torch.float32]
    low = _sum_where(probability > at * (1 + equal), probability)
    high = _sum_where(probability >= at * (1 - equal), probability)
    return Border(low, high, _counted(probability, mass))


def of_angle(seen: CircularMoments, log_prob: Float[Tensor, "batch"], mass: float) -> Border:
    """Return the result for an angle by cubic interpolation of density and slope on a finer grid than the moments'."""
    rows = max(1, BLOCK // (2 * FINER * len(seen.moments)))
    parts = zip(seen.moments.split(rows, 1), seen.resolved.split(rows), log_prob.split(rows), strict=True)
    found = [_of_angle(CircularMoments(moments, known), at, mass) for moments, known, at in parts]
    return Border(*(torch.cat(numbers) for numbers in zip(*found, strict=True)))


def _of_angle(seen: CircularMoments, log_prob: Float[Tensor, "batch"], mass: float) -> Border:
    cubic = Cubic.of(seen)
    level, equal = log_prob.double().exp(), EQUAL[log_prob.dtype]
    low, _ = cubic.above(level)
    high = low.clone()
    # on a plateau or at a mode rounding would decide: take both masses with a tolerance
    flat = ((cubic.density - level).abs() <= equal * level).any(0) | (level >= cubic.density.amax(0))
    if bool(flat.any()):
        here = cubic.rows(flat)
        low[flat], high[flat] = (here.above(level[flat] * factor)[0] for factor in (1 + equal, 1 - equal))
    missing = log_prob.isnan() | seen.moments[0].isnan()
    found = (low.clamp(0, 1), high.clamp(0, 1), cubic.size(mass))
    return Border(*(torch.where(missing, torch.nan, number) for number in found))


class Cubic(NamedTuple):
    """Density on the circle as a cubic Hermite polynomial in each grid cell; its error is of the cell's fourth power.

    Attributes:
        density: density at the points of the grid, (point, batch), per radian.
        slope: derivative at each point times the width of a cell.
    """

    density: Float[Tensor, "point batch"]
    slope: Float[Tensor, "point batch"]

    @classmethod
    def of(cls, seen: CircularMoments) -> "Cubic":
        """Return the cubic through density and slope of the given moments."""
        density = seen.density(FINER)
        return cls(density, seen.density(FINER, slope=True) * (2 * math.pi / len(density)))

    def rows(self, chosen: Tensor) -> "Cubic":
        """Return the densities of the chosen items of the batch."""
        return Cubic(self.density[:, chosen], self.slope[:, chosen])

    def above(self, level: Float[Tensor, "batch"]) -> tuple[Float[Tensor, "batch"], Float[Tensor, "batch"]]:
        """Return the mass where the density is at least the level, and the length of that region, radians."""
        left, right = self.density, self.density.roll(-1, 0)
        rise, fall = self.slope, self.slope.roll(-1, 0)
        first, second = left >= level, right >= level
        whole = first & second
        mass = torch.where(whole, (left + right) / 2 + (rise - fall) / 12, 0.0).sum(0)
        length = whole.sum(0).double()
        # cells with one border, and cells whose extremum may cross the level although neither end does
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
        """Return the length of the highest-density region of the given mass, radians.

        The level is interpolated between two levels that the grid's points suggest, and this bracket is narrowed. The
        mass that is then still missing is divided by the level, because the mass grows by the level times the growth of
        the length.
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
    """Return the mass and length above the level in cells with a border, in cells, less what has been counted already.

    Args:
        ends: density at the left and right end, slopes at the left and right end.
        level: density of the border.
        turning: whether the cell may hold two borders, one on each side of a turning point; otherwise it holds one.
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
    """Return the place where a function changes its sign, by bisection; any place in between if it does not."""
    start = function(low).sign()
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        same = function(middle).sign() == start
        low, high = torch.where(same, middle, low), torch.where(same, high, middle)
    return (low + high) / 2


def of_draws(density: Distribution, value: Tensor, mass: float, samples: int) -> Border:
    """Return the result by the target's rank among draws; the size of one number's region is E[1{p(X) ≥ t} / p(X)]."""
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
    """Return how many cells hold the mass `wanted`, taking the heaviest first and a part of the last one."""
    ordered = mass.sort(0, descending=True).values
    before = ordered.cumsum(0) - ordered
    share = torch.where(ordered > 0, (wanted - before) / ordered, 0.0)
    return share.clamp(0, 1).sum(0)


def covered(low: Tensor, high: Tensor, levels: Float[Tensor, "level"]) -> Float[Tensor, "batch level"]:
    """Return the probability that a number drawn uniformly between low and high is at most each level.

    Ties are therefore broken without drawing (the nonrandomized transform of Czado, Gneiting & Held 2009, eq. 2).
    """
    low, high = low.unsqueeze(-1), high.unsqueeze(-1)
    width = high - low
    inside = torch.where(width > 0, ((levels - low) / width).clamp(0, 1), (low <= levels).double())
    return torch.where(width.isnan(), torch.nan, inside)
