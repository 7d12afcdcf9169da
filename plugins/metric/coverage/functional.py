"""Mass of the highest-density region that ends at the target, and size of the region of a given mass.

A highest-density region holds all values whose density is at least a level. Its mass is its probability.
"""

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
from framework.distributions.protocol import Region, highest_region, mahalanobis, normals

EQUAL = {torch.float32: 1e-6, torch.float64: 1e-12}
"""Relative difference, for each dtype, below which two densities count as equal, so that rounding has no influence."""
FINER = 8
"""Factor by which the grid for regions is finer than the grid on which the density is evaluated."""
BLOCK = 2**18
"""Number of angles that are processed at once: enough to make calls cheap, few enough for the processor's cache."""
HALVINGS = 40
"""Number of bisection steps inside a cell; they locate a border to 1e-12 of the cell."""
SECANTS = 2
"""Number of secant steps to the level of a region of a given mass; the grid brackets the level to about 10 %."""


def border(density: Distribution, value: Tensor, mass: float, samples: int) -> Region:
    """Return the masses of the highest-density regions that end at the targets, and the size of the region of `mass`.

    The region that ends at a target holds the values whose density is higher than that of the target. Its mass is `low`
    of the result; `high` is the mass of all values with at least the density of the target.

    Masses and size are exact for classes, for normal densities, for densities that `highest_region` knows, and for an
    angle whose density a grid resolves. Otherwise they are estimated from `samples` draws: the masses follow from the
    rank of the target's density among the densities of the draws. This rank depends on the draws, but it is exactly
    uniform if the density is the true one. The size is a number of labels, or is in radians or the unit of the target;
    it is NaN for a target of several numbers. If the target is drawn from the density, a number drawn uniformly between
    `low` and `high` is uniform on [0, 1].

    Args:
        density: batch_shape (batch,).
        value: (batch, *event).
        mass: mass of the region whose size is returned, in (0, 1).
        samples: number of draws.
    """
    if density.has_enumerate_support:
        return class_border(density, value, mass)
    single_number = tuple(density.event_shape) == (1,)
    region = highest_region(density, value, mass, EQUAL) if single_number else None
    if region is not None:
        return region
    if single_number and isinstance(density.support, Circular):
        moments = circular_moments(density)
        exact = angle_border(moments, density.log_prob(value), mass)
        if bool(moments.resolved.all()):
            return exact
        sampled = sampled_border(density, value, mass, samples)
        return Region(*(torch.where(moments.resolved, a, b) for a, b in zip(exact, sampled, strict=True)))
    distance = mahalanobis(density, value)
    if distance is None:
        return sampled_border(density, value, mass, samples)
    # the squared Mahalanobis distance of draws of a normal is χ² with one degree of freedom for each number
    inside = torch.special.gammainc(torch.full_like(distance, density.event_shape[0] / 2), distance / 2)
    known = normals(density)
    if known is None:
        return Region(inside, inside, torch.full_like(inside, torch.nan))
    quantile = torch.special.ndtri(torch.tensor((1 + mass) / 2, dtype=torch.float64))
    return Region(inside, inside, 2 * quantile.to(inside) * known.scale.squeeze(-1))


def class_border(density: Distribution, value: Int[Tensor, "batch"], mass: float) -> Region:
    """Return the masses of the regions that end at the true class, and the size of the region of mass `mass`.

    `low` of the result is the probability of all classes that are more likely than the true class, and `high` that of
    all classes that are at least as likely. The size is the number of most likely labels that hold `mass` together. The
    last of these labels counts only with the share of its probability that is needed, so that the size is not an
    integer.
    """
    probability = class_probabilities(density).T
    at = probability.gather(0, require_labels(value.long(), len(probability)).unsqueeze(0))
    equal = EQUAL[torch.float32]
    low = _sum_where(probability > at * (1 + equal), probability)
    high = _sum_where(probability >= at * (1 - equal), probability)
    return Region(low, high, _count_cells(probability, mass))


def angle_border(moments: CircularMoments, log_prob: Float[Tensor, "batch"], mass: float) -> Region:
    """Return, for one angle, the masses of the regions that end at the target, and the size of the region of `mass`.

    `low` of the result is the probability of all angles with a higher density than the target, and `high` that of all
    angles with at least its density. All results are computed by cubic interpolation of the density and its derivative
    on a fine grid.

    Args:
        moments: moments of the density, which give its values on the grid.
        log_prob: log-density at the target.
        mass: mass of the region whose size is returned.
    """
    rows = max(1, BLOCK // (2 * FINER * len(moments.moments)))
    parts = zip(
        moments.moments.split(rows, 1), moments.resolved.split(rows), log_prob.split(rows), strict=True
    )
    borders = [
        _angle_border_of_part(CircularMoments(moment_part, known), at, mass)
        for moment_part, known, at in parts
    ]
    return Region(*(torch.cat(numbers) for numbers in zip(*borders, strict=True)))


def _angle_border_of_part(moments: CircularMoments, log_prob: Float[Tensor, "batch"], mass: float) -> Region:
    cubic = Cubic.of(moments)
    level, equal = log_prob.double().exp(), EQUAL[log_prob.dtype]
    low, _ = cubic.above(level)
    high = low.clone()
    # on a plateau or at a mode, rounding would decide; therefore compute both masses with a tolerance
    flat = ((cubic.density - level).abs() <= equal * level).any(0) | (level >= cubic.density.amax(0))
    if bool(flat.any()):
        flat_items = cubic.rows(flat)
        low[flat], high[flat] = (
            flat_items.above(level[flat] * factor)[0] for factor in (1 + equal, 1 - equal)
        )
    missing = log_prob.isnan() | moments.moments[0].isnan()
    border = (low.clamp(0, 1), high.clamp(0, 1), cubic.size(mass))
    return Region(*(torch.where(missing, torch.nan, number) for number in border))


class Cubic(NamedTuple):
    """Density on the circle as a cubic Hermite polynomial in each grid cell.

    The error is proportional to the fourth power of the cell width.

    Attributes:
        density: density at the points of the grid, (point, batch), per radian.
        slope: derivative at each point, times the width of a cell.
    """

    density: Float[Tensor, "point batch"]
    slope: Float[Tensor, "point batch"]

    @classmethod
    def of(cls, moments: CircularMoments) -> "Cubic":
        """Return the polynomials that have the values and derivatives of the density with these moments."""
        density = moments.density(FINER)
        return cls(density, moments.density(FINER, slope=True) * (2 * math.pi / len(density)))

    def rows(self, chosen: Tensor) -> "Cubic":
        """Return the polynomials of some items of the batch, which `chosen` selects by index or by a Boolean mask."""
        return Cubic(self.density[:, chosen], self.slope[:, chosen])

    def above(self, level: Float[Tensor, "batch"]) -> tuple[Float[Tensor, "batch"], Float[Tensor, "batch"]]:
        """Return the mass and the length, radians, of the region in which the density is at least `level`."""
        left, right = self.density, self.density.roll(-1, 0)
        rise, fall = self.slope, self.slope.roll(-1, 0)
        first, second = left >= level, right >= level
        whole = first & second
        mass = torch.where(whole, (left + right) / 2 + (rise - fall) / 12, 0.0).sum(0)
        length = whole.sum(0).double()
        # cells with one border, and cells that may hold two borders because the extremum inside may cross the level
        for chosen, turning in (
            (first ^ second, False),
            ((rise > 0) & (fall < 0) & ~first & ~second, True),
            ((rise < 0) & (fall > 0) & whole, True),
        ):
            cell, item = chosen.nonzero(as_tuple=True)
            if len(cell) == 0:
                continue
            ends = torch.stack([table[cell, item] for table in (left, right, rise, fall)])
            more, longer = _border_part(ends, level[item], turning=turning)
            mass.index_add_(0, item, more)
            length.index_add_(0, item, longer)
        step = 2 * math.pi / len(self.density)
        return mass * step, length * step

    def size(self, mass: float) -> Float[Tensor, "batch"]:
        """Return the length of the highest-density region of the given mass, radians.

        The values at the grid points give two levels between which the level of the region lies; secant steps narrow
        this bracket. The mass that is then still missing, divided by the level, is added to the length: at the border
        the density equals the level, so that a small change of length changes the mass by the level times this change.
        """
        step = 2 * math.pi / len(self.density)
        ordered = self.density.clamp(min=0).sort(0, descending=True).values
        cell_count = ((ordered.cumsum(0) * step) < mass).sum(0, keepdim=True).clamp(max=len(ordered) - 1)
        lowest = torch.finfo(torch.float64).tiny
        high, low = (
            ordered.gather(0, (cell_count + offset).clamp(0, len(ordered) - 1)).squeeze(0).clamp(min=lowest)
            for offset in (-4, 4)
        )
        more, less = self.above(low)[0], self.above(high)[0]
        level, mass_above, length = high, less, torch.zeros_like(less)
        for _ in range(SECANTS):
            share = torch.where(more > less, (mass - less) / (more - less), 0.0).clamp(0, 1)
            level = high + share * (low - high)
            mass_above, length = self.above(level)
            enough = mass_above >= mass
            low, more = torch.where(enough, level, low), torch.where(enough, mass_above, more)
            high, less = torch.where(enough, high, level), torch.where(enough, less, mass_above)
        return length + (mass - mass_above) / level


def _border_part(
    ends: Float[Tensor, "4 cell"], level: Float[Tensor, "cell"], *, turning: bool
) -> tuple[Float[Tensor, "cell"], Float[Tensor, "cell"]]:
    """Return the mass and the length that each cell at a border adds to a highest-density region.

    A border is a point at which the density crosses the level: the region begins or ends there. The unit of length is
    the width of a cell.

    Args:
        ends: density at the left and right end of each cell, then slopes at the left and right end.
        level: density at the border.
        turning: True if the cell may hold two borders, one on each side of an extremum; the cell was then counted as if
            it held none, and the result corrects this. False if the cell holds one border and was not counted.
    """
    left, right, rise, fall = ends
    square, cube = 3 * (right - left) - 2 * rise - fall, 2 * (left - right) + rise + fall

    def height(at: Tensor) -> Tensor:
        return left + at * (rise + at * (square + at * cube)) - level

    def until(at: Tensor) -> Tensor:
        return at * (left + at * (rise / 2 + at * (square / 3 + at * cube / 4)))

    zeros, ones = torch.zeros_like(left), torch.ones_like(left)
    if not turning:
        border = _root(height, zeros, ones)
        falling = left >= level
        mass = torch.where(falling, until(border), until(ones) - until(border))
        return mass, torch.where(falling, border, 1 - border)
    top = _root(lambda at: rise + at * (2 * square + 3 * at * cube), zeros, ones)
    before, after = _root(height, zeros, top), _root(height, top, ones)
    beyond = height(top).sign() != height(zeros).sign()
    # add a maximum above the level; subtract a minimum below the level, whose cell was counted completely
    sign = torch.where(beyond, -height(zeros).sign(), 0.0)
    return sign * (until(after) - until(before)), sign * (after - before)


def _root(function: Callable[[Tensor], Tensor], low: Tensor, high: Tensor) -> Tensor:
    """Return the point between `low` and `high` at which a function changes its sign, by bisection.

    The result is arbitrary if the sign does not change.
    """
    start = function(low).sign()
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        same = function(middle).sign() == start
        low, high = torch.where(same, middle, low), torch.where(same, high, middle)
    return (low + high) / 2


def sampled_border(density: Distribution, value: Tensor, mass: float, samples: int) -> Region:
    """Return the masses of the regions that end at the target, and the size of the region of `mass`, from samples.

    The masses follow from the rank of the target's density among the densities of the samples. For one number, the size
    of the region {x: p(x) ≥ t} is estimated as E[1{p(X) ≥ t} / p(X)], where the level t is the quantile of the sampled
    densities with the given mass above it. For several numbers the size is NaN.
    """
    draws = density.sample(torch.Size((samples,)))
    log_prob, at = density.log_prob(draws).double(), density.log_prob(value).double()
    equal = EQUAL[torch.float32]
    low = (log_prob > at + equal).double().sum(0) / (samples + 1)
    high = ((log_prob >= at - equal).double().sum(0) + 1) / (samples + 1)
    size = torch.full_like(low, torch.nan)
    if tuple(density.event_shape) == (1,):
        inside_count = max(1, round(mass * samples))
        size = (-log_prob.sort(0, descending=True).values[:inside_count]).exp().sum(0) / samples
    missing = log_prob.isnan().any(0) | at.isnan()
    return Region(*(torch.where(missing, torch.nan, number) for number in (low, high, size)))


def _sum_where(chosen: Tensor, probability: Tensor) -> Tensor:
    return torch.where(chosen, probability, 0.0).sum(0).clamp(max=1)


def _count_cells(mass: Float[Tensor, "cell batch"], wanted: float) -> Float[Tensor, "batch"]:
    """Return how many of the cells with the largest masses hold the mass `wanted`, with a fraction of the last one."""
    ordered = mass.sort(0, descending=True).values
    before = ordered.cumsum(0) - ordered
    share = torch.where(ordered > 0, (wanted - before) / ordered, 0.0)
    return share.clamp(0, 1).sum(0)


def coverage_probability(
    low: Tensor, high: Tensor, levels: Float[Tensor, "level"]
) -> Float[Tensor, "batch level"]:
    """Return for each level the probability that a number drawn uniformly from [`low`, `high`] is at most the level.

    This probability replaces a random draw if other values have the same density as the target (nonrandomized transform
    of Czado, Gneiting & Held 2009, eq. 2).
    """
    low, high = low.unsqueeze(-1), high.unsqueeze(-1)
    width = high - low
    inside = torch.where(width > 0, ((levels - low) / width).clamp(0, 1), (low <= levels).double())
    return torch.where(width.isnan(), torch.nan, inside)
