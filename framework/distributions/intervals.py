"""Central intervals of densities of real numbers or angles, from the distribution function or else from draws."""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.affine import AffineDensity
from framework.distributions.batch_shapes import Reshaped
from framework.distributions.circular import Circular, circular_median, wrap
from framework.distributions.circular_moments import circular_moments
from framework.distributions.closed_forms import normal_quantile
from framework.distributions.protocol import (
    Normals,
    arc_probability,
    cdf,
    marginal,
    mode_candidates,
    normals,
    peak_widths,
)
from framework.distributions.symmetric import Symmetric
from framework.errors import UserError

DRAWS = 9999
"""Number of draws from which an interval is computed if the distribution function of its density is not known.

The true probability of an interval that is computed from the draws for the probability 0.9 then has a standard error
of 0.003.
"""
ROUNDS = 200
"""Largest number of steps in which a bracket is narrowed; the search normally ends earlier, because of EXACT."""
EXACT = 1e-12
"""Width of a bracket at which the search ends, as a multiple of its distance from `find_crossing`'s `center`."""
AROUND = 24
"""Number of equally spaced angles at which the search for the median of an angle starts, besides those near peaks."""
RUNGS, NARROWER = 16, 8.0
"""Number of arcs that are tried first in the search for an arc of given probability, and the ratio of their widths."""
_FURTHEST = 1100
"""Largest number of times that a bracket is doubled; 1024 doublings lead from 1 to the largest float64 number."""
_FEW = 5.0
"""Smallest expected number of draws beyond an end of an interval for which the error of this end is computed."""


class Interval(NamedTuple):
    """Central interval of each number of a density; every field has the shape (*batch, number) and is float64.

    Attributes:
        low: the lower end of the interval. Half of the remaining probability lies beyond each end. Angles are in
            radians: `low` is in [-π, π), and the interval is the arc from `low` counter-clockwise to `high`, at most
            one turn further. If the angle covers the whole circle, the circular median splits this arc into two parts
            of equal probability.
        high: the upper end of the interval.
        low_error: standard error of the lower end, in the unit of the number. The error is 0 where the end was computed
            without draws, and infinite where fewer than 5 draws are expected beyond the end.
        high_error: standard error of the upper end, in the unit of the number, with the same special values.
    """

    low: Tensor
    high: Tensor
    low_error: Tensor
    high_error: Tensor


@torch.no_grad()
def central_interval(density: Distribution, mass: float, draws: int = DRAWS) -> Interval:
    """Return the central interval with probability `mass` for each number of a density of real numbers or angles.

    Ends are computed from `Symmetric.half_width`, `normals`, `cdf` or `arc_probability`, or from the Fourier series of
    an angle's density (`circular_moments`), where one of these is known. Otherwise they are order statistics of `draws`
    draws.

    Args:
        density: a density with event_shape (number,).
        mass: probability of the interval, in (0, 1).
        draws: number of draws where the ends cannot be computed.
    """
    if isinstance(density, AffineDensity):  # in float64, so that a location far from 0 costs no digit
        inner = central_interval(density.density, mass, draws)
        location, scale = density.location.double(), density.scale.double()
        ends = (location + scale * end for end in inner[:2])
        return Interval(*ends, *(scale * error for error in inner[2:]))
    angles = isinstance(density.support, Circular)
    if density.event_shape.numel() == 1:
        known = _interval_of_angle(density, mass) if angles else _interval_of_real(density, mass)
        if known is None:
            return _interval_of_draws(density, mass, draws)
        missing = known.low.isnan()
        if not bool(missing.any()):
            return known
        # draws do not help where the density is NaN
        lost = missing & ~density.log_prob(density.sample()).isnan().unsqueeze(-1)
        return _select(lost, _interval_of_draws(density, mass, draws), known) if bool(lost.any()) else known
    try:
        parts = [marginal(density, index) for index in range(density.event_shape[0])]
    except UserError:
        return _interval_of_draws(density, mass, draws)
    intervals = [central_interval(part, mass, draws) for part in parts]
    return Interval(*(torch.cat(ends, -1) for ends in zip(*intervals, strict=True)))


def _select(chosen: Tensor, first: Interval, second: Interval) -> Interval:
    return Interval(*(torch.where(chosen, *pair) for pair in zip(first, second, strict=True)))


def _exact_interval(low: Tensor, high: Tensor) -> Interval:
    """Return the interval with the ends `low` and `high`, (*batch,), both with a standard error of 0."""
    none = torch.zeros_like(low).unsqueeze(-1)
    return Interval(low.unsqueeze(-1), high.unsqueeze(-1), none, none)


def _tails(mass: float) -> Tensor:
    """Return the probabilities below the lower and the upper end of an interval of probability `mass`, (2,)."""
    return torch.tensor([(1 - mass) / 2, (1 + mass) / 2], dtype=torch.float64)


def _interval_of_real(density: Distribution, mass: float) -> Interval | None:
    """Return the interval with probability `mass` of one real number; None if its distribution function is unknown."""
    below = _tails(mass)
    known = normals(density)
    if known is not None:
        return _exact_interval(*_normal_quantiles(known, below.to(known.mean)))
    like = density.sample(torch.Size((33,))).double()
    below = below.to(like.device)
    if cdf(density, like[0].to(density.sample().dtype)) is None:
        return None
    return _exact_interval(*_quantiles_by_search(partial(_cdf_of, density), below, like.squeeze(-1)))


def _cdf_of(density: Distribution, value: Float[Tensor, "place *batch"]) -> Tensor:
    probability = cdf(density, value.unsqueeze(-1))
    assert probability is not None
    return probability


def _normal_quantiles(known: Normals, below: Float[Tensor, "place"]) -> Float[Tensor, "place *batch"]:
    """Return the quantiles of mixtures of normals at the probabilities `below`.

    A quantile of a mixture lies between the smallest and the largest quantile of its components, where the search
    starts.
    """
    z = normal_quantile(below).reshape(-1, *(1,) * known.mean.dim())
    quantiles = known.mean + z * known.scale  # (place, *batch, component)
    if known.mean.shape[-1] == 1:
        return quantiles.squeeze(-1)
    weights = known.log_weights.exp()
    counts = weights > 0
    low = torch.where(counts, quantiles, math.inf).amin(-1)
    high = torch.where(counts, quantiles, -math.inf).amax(-1)

    def mass_below(value: Tensor) -> Tensor:
        residual = value.unsqueeze(-1) - known.mean
        standard = torch.where(residual == 0, residual, residual / known.scale)
        return torch.where(counts, weights * torch.special.ndtr(standard), 0.0).sum(-1)

    levels = below.reshape(-1, *(1,) * (known.mean.dim() - 1))
    center = torch.where(counts, known.mean, 0.0).sum(-1) / counts.sum(-1).clamp(min=1)
    return find_crossing(mass_below, levels, low, high, center)


def _quantiles_by_search(
    mass_below: Callable[[Tensor], Tensor],
    below: Float[Tensor, "place"],
    samples: Float[Tensor, "draw *batch"],
) -> Float[Tensor, "place *batch"]:
    """Return the quantiles of any density of one real number at the probabilities `below`.

    Args:
        mass_below: distribution function of the density.
        below: probabilities.
        samples: a few draws. The first bracket is around their median, and it grows until it contains the quantile.
    """
    center = samples.median(0).values
    samples = samples.sort(0).values
    wide = samples[-1 - len(samples) // 4] - samples[len(samples) // 4]
    # if all draws are equal, the width is the last digit of this number
    step = torch.maximum(wide, 1e-7 * center.abs()).clamp(min=1e-300)
    levels = below.reshape(-1, *(1,) * center.dim())
    low, high = (
        (center - step).expand(len(below), *center.shape),
        (center + step).expand(len(below), *center.shape),
    )
    for _ in range(_FURTHEST):
        above, under = mass_below(low) > levels, mass_below(high) < levels
        if not bool((above | under).any()):
            break
        step = 2 * step
        low, high = torch.where(above, center - step, low), torch.where(under, center + step, high)
    return find_crossing(mass_below, levels, low, high, center)


def find_crossing(
    rising: Callable[[Tensor], Tensor], level: Tensor, low: Tensor, high: Tensor, center: Tensor
) -> Tensor:
    """Return the argument x at which a function that never falls reaches `level`; NaN where the function is NaN.

    All tensors broadcast to one shape, and each element has its own search. The search uses inverse quadratic
    interpolation where this is safe, and bisection elsewhere (Chandrupatla 1997).

    Args:
        rising: the function, which maps a tensor of arguments to a tensor of values of the same shape.
        level: the value that the function reaches.
        low: lower end of a bracket of x.
        high: upper end of the bracket.
        center: reference point. The search ends where the bracket is as narrow as EXACT times the bracket's distance
            from this point, or where its ends are neighbouring floating-point numbers.
    """
    level, low, high = torch.broadcast_tensors(level, low, high)
    a, b = high, low
    excess_a, excess_b = rising(a) - level, rising(b) - level
    broken = excess_a.isnan() | excess_b.isnan()
    part = torch.full_like(a, 0.5)
    best, least_excess = (
        torch.where(excess_a.abs() < excess_b.abs(), a, b),
        torch.minimum(excess_a.abs(), excess_b.abs()),
    )
    for _ in range(ROUNDS):
        point = a + part * (b - a)
        excess = rising(point) - level
        same = (excess >= 0) == (excess_a >= 0)
        # c is the end that was given up: the third point of the parabola
        c, excess_c = torch.where(same, a, b), torch.where(same, excess_a, excess_b)
        b, excess_b = torch.where(same, b, a), torch.where(same, excess_b, excess_a)
        a, excess_a = point, excess
        best = torch.where(excess.abs() <= least_excess, point, best)
        least_excess = torch.minimum(least_excess, excess.abs())
        least = torch.maximum(EXACT * (best - center).abs(), 4e-16 * best.abs()) + 1e-320
        width = (b - a).abs()
        if bool(((width <= least) | (least_excess == 0) | broken).all()):
            break
        across, rise = (a - b) / (c - b), (excess_a - excess_b) / (excess_c - excess_b)
        safe = (1 - (1 - across).sqrt() < rise) & (rise < across.sqrt())
        interpolated = excess_a / (excess_b - excess_a) * excess_c / (excess_b - excess_c) + (c - a) / (
            b - a
        ) * excess_a / (excess_c - excess_a) * excess_b / (excess_c - excess_b)
        part = torch.where(safe & interpolated.isfinite(), interpolated, 0.5)
        edge = (least / (2 * width)).nan_to_num(nan=0.5).clamp(max=0.5)
        part = torch.maximum(edge, torch.minimum(part, 1 - edge))
    return torch.where(broken, math.nan, best)


def _interval_of_angle(density: Distribution, mass: float) -> Interval | None:
    """Return the interval with probability `mass` of one angle; None if the batch is empty.

    The ends are NaN for items for which neither `arc_probability` nor the Fourier series (`circular_moments`) is known.
    """
    flat = Reshaped(density, (density.batch_shape.numel(),))
    if not len(flat.batch_shape) or flat.batch_shape.numel() == 0:
        return None
    support = density.support
    assert isinstance(support, Circular)
    if isinstance(density, Symmetric) and support.ranges is None:
        width = density.half_width(mass)
        if width is not None:
            first = wrap(density.location.double() - width).squeeze(-1)
            return _exact_interval(first, first + 2 * width.squeeze(-1))
    law = _arc_function(flat)
    low, high = support.ranges[0] if support.ranges is not None else (-math.pi, math.pi)
    # a part of the circle has two ends, so the quantiles start at the lower end
    if high - low < 2 * math.pi - 1e-9:
        below = _tails(mass).to(flat.sample().device).unsqueeze(-1)
        places = below.new_full((2, flat.batch_shape[0]), low)

        def mass_below(value: Tensor) -> Tensor:
            return law(places.expand_as(value), value)

        ends = find_crossing(mass_below, below, places, torch.full_like(places, high), places)
        return _exact_interval(*(end.reshape(density.batch_shape) for end in ends))
    center = _circular_center(law, flat)
    ahead = _width_of_mass(lambda width: law(center.expand_as(width), center + width), mass / 2, center)
    behind = _width_of_mass(lambda width: law(center - width, center.expand_as(width)), mass / 2, center)
    first = wrap(center - behind)
    return _exact_interval(*(end.reshape(density.batch_shape) for end in (first, first + behind + ahead)))


def _width_of_mass(
    mass_within: Callable[[Tensor], Tensor], mass: float, center: Float[Tensor, "item"]
) -> Float[Tensor, "item"]:
    """Return the width, radians up to π, of the arc on one side of `center` whose probability is `mass`.

    Args:
        mass_within: function from the width of this arc to its probability.
        mass: probability.
        center: end of the arc, for each item.
    """
    power = torch.arange(RUNGS, dtype=torch.float64, device=center.device).unsqueeze(-1)
    rungs = (math.pi * NARROWER**-power).expand(RUNGS, len(center))
    enough = (mass_within(rungs) >= mass).sum(0).clamp(min=1)  # falling
    high = math.pi * NARROWER ** (1.0 - enough)
    low = torch.where(enough < RUNGS, high / NARROWER, 0.0)
    zeros = torch.zeros_like(center)
    return find_crossing(mass_within, torch.full_like(center, mass), low, high, zeros)


def _arc_function(flat: Distribution) -> Callable[[Tensor, Tensor], Tensor]:
    """Return a function of two angles, (*sample, item) each: the probability of the arc from the first to the second.

    The arc runs counter-clockwise. The probability is NaN for items for which it is not known.

    Args:
        flat: density of one angle, with one batch dimension.
    """
    probe = torch.zeros((*flat.batch_shape, 1), dtype=torch.float64, device=flat.sample().device)
    if arc_probability(flat, probe, probe + 1) is not None:

        def exact(start: Tensor, end: Tensor) -> Tensor:
            probability = arc_probability(flat, start.unsqueeze(-1), end.unsqueeze(-1))
            assert probability is not None
            return probability

        return exact
    series = circular_moments(flat)

    def from_series(start: Tensor, end: Tensor) -> Tensor:
        return torch.where(
            series.resolved, series.arc_probability(*torch.broadcast_tensors(start, end)), math.nan
        )

    return from_series


def _circular_center(law: Callable[[Tensor, Tensor], Tensor], flat: Distribution) -> Float[Tensor, "item"]:
    """Return the circular median: the angle in [-π, π) with the least expected deviation (thesis eq. 3.23).

    If the angle increases, the expected deviation falls where less than half of the probability lies on the half circle
    behind it (clockwise), and rises where more than half lies there. So the minima are where this probability reaches
    one half. Of several minima, the one with the lowest deviation at the neighbouring `_nodes` is taken. If there is no
    minimum (uniform density), the mode is returned.

    Args:
        law: function that `_arc_function` returns for `flat`.
        flat: density of one angle, with one batch dimension.
    """
    nodes = _nodes(flat)
    behind = law(nodes - math.pi, nodes) - 0.5  # half the slope of the deviation
    last = torch.cat([nodes[1:], nodes[:1] + 2 * math.pi])
    ends = torch.cat([behind[1:], behind[:1]])
    # the deviation at each node, by the trapezium rule on its slope
    deviation = ((behind + ends) * (last - nodes)).cumsum(0)
    deviation = torch.cat([torch.zeros_like(deviation[:1]), deviation[:-1]])
    lowest = torch.minimum(deviation, torch.cat([deviation[1:], deviation[:1]]))
    crosses = (behind < 0) & (ends >= 0)
    index = torch.where(crosses, lowest, math.inf).argmin(0, keepdim=True)
    start, stop = nodes.gather(0, index).squeeze(0), last.gather(0, index).squeeze(0)
    middle = find_crossing(
        lambda angle: law(angle - math.pi, angle), torch.full_like(start, 0.5), start, stop, start
    )
    # a density without a middle (the uniform one) has no crossing; its mode is as good as any angle
    mode = flat.mode.squeeze(-1).double()
    return wrap(torch.where(crosses.any(0) | behind.isnan().any(0), middle, mode))


def _nodes(flat: Distribution) -> Float[Tensor, "node item"]:
    """Return ascending angles in [-π, π): around the whole circle, and near each peak at multiples of its width."""
    places = wrap(mode_candidates(flat).squeeze(-1).double())
    width = peak_widths(flat).double().nan_to_num(nan=1.0, posinf=1.0)
    near = torch.tensor([-3, -1, 0, 1, 3], dtype=torch.float64, device=places.device)
    around = (places + near.reshape(-1, 1, 1) * width).flatten(0, 1)
    even = torch.linspace(-math.pi, math.pi, AROUND + 1, dtype=torch.float64, device=places.device)[:-1]
    angles = torch.cat([wrap(around), even.unsqueeze(-1).expand(-1, places.shape[-1])])
    return angles.sort(0).values


def _interval_of_draws(density: Distribution, mass: float, draws: int) -> Interval:
    """Return the interval with probability `mass`, whose ends are order statistics of `draws` draws.

    Of n draws in ascending order, the i-th is taken as the quantile i / (n + 1). Angles that cover the whole circle are
    ordered by their signed distance from their circular median.
    """
    samples = density.sample(torch.Size((draws,))).double()
    angles = isinstance(density.support, Circular)
    middle_angle = circular_median(samples) if angles else torch.zeros_like(samples[0])
    support = density.support
    if isinstance(support, Circular) and support.ranges is not None:
        part = [high - low < 2 * math.pi - 1e-9 for low, high in support.ranges]
        middle_angle = torch.where(torch.tensor(part, device=samples.device), 0.0, middle_angle)
    ordered = (wrap(samples - middle_angle) if angles else samples).sort(0).values
    tail = (1 - mass) / 2
    rank = min(draws // 2, max(0, round(tail * (draws + 1)) - 1))
    low, high = ordered[rank], ordered[-1 - rank]
    # the rank of a quantile among n draws is binomial: one standard deviation of it, to either side
    spread = max(1, round(math.sqrt(draws * tail * (1 - tail))))
    first, last = max(0, rank - spread), min(draws - 1, rank + spread)
    errors = [
        (ordered[last] - ordered[first]) / 2,
        (ordered[-1 - first] - ordered[-1 - last]) / 2,
    ]
    if draws * tail < _FEW:
        errors = [torch.full_like(error, math.inf) for error in errors]
    if angles:
        start = wrap(middle_angle + low)
        return Interval(start, start + (high - low), *errors)
    return Interval(low, high, *errors)
