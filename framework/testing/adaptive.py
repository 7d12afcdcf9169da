"""Adaptive quadrature of a density of one or two numbers, however narrow: boxes are split where two rules disagree."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular, wrap
from framework.distributions.protocol import mode_candidates

RULES = {1: (10, 6), 2: (8, 5)}
"""Gauss-Legendre points per side of the two rules; a box on which their sums differ is split."""
TOLERANCE = {1: 1e-10, 2: 1e-8}
ROUNDS = {1: 60, 2: 40}
MOST = {1: 128, 2: 48}
"""Largest number of boxes of a batch row that are split in one round."""
MOST_PEAKS = 64
HIDDEN = 2.0
"""Ratio of a known value of the integrand to that at the highest node above which a box is split."""
REACH = 36.0
"""Bound on the coordinate s of values mode + a sinh(s), where a is the density's own width.

For reals the quadrature reaches sinh 36 = 2e15 widths, for angles half a turn.
"""


@dataclass(frozen=True)
class Boxes:
    """Result of the quadrature of a density with batch_shape (rows,).

    Attributes:
        value: Values at which the density was evaluated last, (node, rows, number).
        log_prob: Log-density at `value`, (node, rows), nats.
        weight: Volume of each node, (node, rows); Σ weight · exp(log_prob) is the integral.
        border: Borders of the boxes of one number, ascending, (box + 1, rows).
        mass: Mass of each box, (box, rows).
        way: Coordinates in which the boxes are cut.
        low, high: Corners of the boxes in these coordinates, (box, rows, number).
    """

    value: Tensor
    log_prob: Tensor
    weight: Tensor
    border: Tensor
    mass: Tensor
    way: "_Map"
    low: Tensor
    high: Tensor

    def mean(self, of: Tensor) -> Tensor:
        """Return ∫ p f, (rows,), for a function f with values (node, rows)."""
        share = self.weight * self.log_prob.exp()
        return torch.where(share > 0, share * of, 0.0).sum(0)

    def entropy(self) -> Tensor:
        """Return the entropy, (rows,), nats."""
        return -self.mean(self.log_prob)

    def doubt(self, of: Callable[[Tensor], Tensor]) -> Tensor:
        """Return a bound on the error of ∫ p f for a function f of values, (rows,).

        The boxes are cut for p rather than for f, and they end at a finite distance. The bound is the difference of the
        two rules, plus a bound on the part beyond the ends for tails that fall like a power.
        """
        shares = []
        for points in RULES[self.low.shape[-1]]:
            value, log_prob, weight = _nodes(self.way, self.low, self.high, points)
            share = weight * log_prob.exp()
            part = torch.where(share > 0, share * of(value).reshape(share.shape), 0.0).sum(1)
            shares.append(part)
        rules = (shares[0] - shares[1]).abs().sum(0)
        if self.way.angles:
            return rules
        outermost = (self.low == self.way.ends[0]).any(-1) | (self.high == self.way.ends[1]).any(-1)
        return rules + 100 * torch.where(outermost, shares[0].abs(), 0.0).sum(0)

    def below(self, value: Tensor) -> Tensor:
        """Return the mass from the first border to `value` (several, rows) of one number.

        For angles the first border is half a turn before the mode.
        """
        place = self.way.back(value.unsqueeze(-1))
        border = self.way.back(self.border.unsqueeze(-1))[..., 0]
        border[0], border[-1] = (end[:, 0] for end in self.way.ends)
        box = torch.searchsorted(border.T.contiguous(), place[..., 0].T.contiguous()).T.clamp(
            1, len(border) - 1
        )
        low = border.gather(0, box - 1).unsqueeze(-1)
        _, log_prob, weight = _nodes(self.way, low, place, RULES[1][0])
        before = torch.cat([torch.zeros_like(self.mass[:1]), self.mass.cumsum(0)]).gather(0, box - 1)
        return before + (weight * log_prob.exp()).sum(1)


class _Map:
    """Map from the coordinates in which boxes are cut to values: sinh along the density's own axes, in its own widths.

    The origin is the highest of some candidates, since the density's mode may be wrong.
    """

    def __init__(self, density: Distribution, candidates: Tensor) -> None:
        self.density = density
        height = self.log_prob(candidates)
        best = height.where(~height.isnan(), -math.inf).argmax(0)
        self.mode = candidates[best, torch.arange(len(best))]
        self.angles = isinstance(density.support, Circular)
        self.chart = isinstance(density.support, Circular) and density.support.ranges is not None
        if self.chart:
            self.mode = wrap(self.mode)
        self.scale = self._widths()
        self.slope = torch.zeros_like(self.mode[:, 0])
        if not self.angles and self.mode.shape[1] == 2:
            self._whiten()
        end = torch.full_like(self.mode, REACH)
        self.ends = -end, end
        if isinstance(density.support, Circular):
            turn = [(-math.pi, math.pi)] * self.mode.shape[1]
            first, last = torch.tensor(density.support.ranges or turn, dtype=torch.float64).T
            if density.support.ranges is None:
                first, last = first + self.mode, last + self.mode
            self.ends = ((first - self.mode) / self.scale).asinh(), ((last - self.mode) / self.scale).asinh()

    def log_prob(self, value: Tensor) -> Tensor:
        like = self.density.sample(torch.Size((0,)))
        return self.density.log_prob(value.to(like.dtype)).double()

    def _widths(self) -> Tensor:
        """Return the distance along each axis at which log p is half a nat below the mode, (rows, number)."""
        steps = 2.0 ** torch.arange(-40, 2 if self.angles else 60, dtype=torch.float64)
        top = self.log_prob(self.mode)
        found = []
        for number in range(self.mode.shape[1]):
            axis = torch.zeros(self.mode.shape[1], dtype=torch.float64)
            axis[number] = 1
            there = self.mode + steps[:, None, None] * axis
            fallen = (top - self.log_prob(there) > 0.5).int()
            first = torch.where(
                fallen.amax(0) > 0, fallen.argmax(0), 40
            )  # width 2^0 = 1 where p does not fall
            found.append(steps[first])
        return torch.stack(found, -1)

    def _whiten(self) -> None:
        """Set the slope of the second number's conditional mode in the first.

        The slope comes from mixed differences over the widths.
        """
        first, second = self.scale[:, 0], self.scale[:, 1]
        corner = {}
        for one, two in product((-1, 0, 1), repeat=2):
            offset = torch.stack([one * first, two * second], -1)
            corner[one, two] = self.log_prob(self.mode + offset)
        mixed = (corner[1, 1] - corner[1, -1] - corner[-1, 1] + corner[-1, -1]) / 4
        bend = corner[0, 1] + corner[0, -1] - 2 * corner[0, 0]
        slope = -mixed / bend * second / first
        self.slope = torch.where(slope.isfinite(), slope, 0.0)
        # along the conditional mode of the second number the width of the first is that of its marginal
        steps = 2.0 ** torch.arange(0, 40, dtype=torch.float64)
        offset = torch.stack([first, self.slope * first], -1)
        fallen = (corner[0, 0] - self.log_prob(self.mode + steps[:, None, None] * offset) > 0.5).int()
        wider = torch.where(fallen.amax(0) > 0, steps[fallen.argmax(0)], 1.0)
        self.scale = torch.stack([first * wider, second], -1)

    def to(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Return values and the volume of the map at coordinates (node, rows, number)."""
        offset = self.scale * place.sinh()
        volume = (self.scale * place.cosh()).prod(-1)
        if place.shape[-1] == 2:
            offset = torch.stack([offset[..., 0], offset[..., 1] + self.slope * offset[..., 0]], -1)
        return self.mode + offset, volume

    def back(self, value: Tensor) -> Tensor:
        """Return the coordinates of values."""
        offset = (wrap(value.double()) if self.chart else value.double()) - self.mode
        if self.angles and not self.chart:
            offset = wrap(offset)
        if offset.shape[-1] == 2:
            offset = torch.stack([offset[..., 0], offset[..., 1] - self.slope * offset[..., 0]], -1)
        return (offset / self.scale).asinh().clamp(*self.ends)


def _rule(points: int, numbers: int) -> tuple[Tensor, Tensor]:
    """Return nodes (points^numbers, numbers) of the unit box and their weights."""
    node, weight = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(points))
    nodes = torch.cartesian_prod(*[(node + 1) / 2] * numbers).reshape(-1, numbers)
    weights = torch.cartesian_prod(*[weight / 2] * numbers).reshape(-1, numbers).prod(-1)
    return nodes, weights


@lru_cache(maxsize=4)
def boxes(density: Distribution) -> Boxes:
    """Return a density of one or two numbers, batch_shape (rows,), in boxes on which two rules agree.

    Candidates for peaks are the mode, `peaks` and draws. A box is also split while it may hide a peak or a ridge.
    """
    humps = mode_candidates(density)[:MOST_PEAKS].double()
    drawn = density.sample(torch.Size((24,))).double()
    seen = torch.cat([density.mode.unsqueeze(0).double(), humps, drawn])
    way = _Map(density, seen)
    humps = way.back(humps)
    numbers = way.mode.shape[1]
    height = way.log_prob(seen)
    place = way.back(seen)
    side = 8 if numbers == 1 else 4
    cut = torch.linspace(0, 1, side + 1, dtype=torch.float64)
    length = way.ends[1] - way.ends[0]
    low = way.ends[0] + torch.cartesian_prod(*[cut[:-1]] * numbers).reshape(-1, 1, numbers) * length
    high = way.ends[0] + torch.cartesian_prod(*[cut[1:]] * numbers).reshape(-1, 1, numbers) * length
    if numbers == 1:
        # A kink at a peak near a border may lie beyond the outermost nodes of both rules, so a border is put there.
        edges = torch.cat([low.expand(-1, *humps.shape[1:]), high[-1:].expand(-1, *humps.shape[1:]), humps])
        edges = edges.sort(0).values
        low, high = edges[:-1], edges[1:]
    parts = _summed(way, low, high, place, height, humps)
    # float32 does not reproduce more digits
    tolerance = TOLERANCE[numbers] if density.log_prob(density.mode).dtype == torch.float64 else 1e-4
    for _ in range(ROUNDS[numbers]):
        split = int((parts[3] > tolerance).sum(0).max())
        if split == 0:
            break
        split = min(split, MOST[numbers])
        order = parts[3].argsort(0, descending=True)
        low, high, across = (_taken(parts[index], order[:split]) for index in (0, 1, 4))
        middle = torch.where(across, (low + high) / 2, math.nan)
        halves = torch.cat([low, middle.fmax(low)]), torch.cat([middle.fmin(high), high])
        fresh = _summed(way, *halves, place, height, humps)
        parts = tuple(
            torch.cat([_taken(old, order[split:]), new]) for old, new in zip(parts, fresh, strict=True)
        )
    return _gathered(way, *parts[:3])


def _taken(part: Tensor, index: Tensor) -> Tensor:
    """Return the entries of `part` (box, rows, ...) at index (some, rows)."""
    if part.dim() == 3:
        index = index.unsqueeze(-1).expand(*index.shape, part.shape[-1])
    return part.gather(0, index)


def _nodes(way: _Map, low: Tensor, high: Tensor, points: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return values (box · node, rows, number), and log-densities and weights (box, node, rows)."""
    nodes, weights = _rule(points, low.shape[-1])
    place = low.unsqueeze(1) + (high - low).unsqueeze(1) * nodes[:, None]
    value, volume = way.to(place.flatten(0, 1))
    shape = (low.shape[0], len(nodes), low.shape[1])
    weight = volume.reshape(shape) * weights[:, None] * (high - low).prod(-1).unsqueeze(1)
    return value, way.log_prob(value).reshape(shape), weight


def _summed(
    way: _Map, low: Tensor, high: Tensor, place: Tensor, height: Tensor, humps: Tensor
) -> tuple[Tensor, ...]:
    """Return boxes, their masses, the urgency to split each, and the number in which to split it.

    Boxes are their corners, low and high. Masses and urgency have shape (box, rows). The number is a mask (box, rows,
    number). A split is urgent where the two sums differ, or where a candidate or the estimate from a known peak is far
    above every node.
    """
    numbers = low.shape[-1]
    sums, highest, rough = [], torch.zeros_like(low[..., 0]), torch.zeros_like(low)
    for points in RULES[numbers]:
        _, log_prob, weight = _nodes(way, low, high, points)
        share = weight * log_prob.exp()
        sums.append(share.sum(1))
        even = share / _rule(points, numbers)[1][:, None]  # mass of the box if this node stood for all of it
        highest = torch.maximum(highest, even.nan_to_num().amax(1))
        if points == RULES[numbers][0]:
            rough = _roughness(even.nan_to_num(), points, numbers)
    size = (high - low).prod(-1)
    inside = ((place.unsqueeze(1) >= low) & (place.unsqueeze(1) <= high)).all(-1)  # (candidate, box, rows)
    _, volume = way.to(place)
    peak = torch.where(inside, (height.exp() * volume).unsqueeze(1), 0.0).amax(0) * size
    # a box with a peak in or near it is split in its longest number, a box with a ridge across the ridge
    known = torch.cat([peak.unsqueeze(0), _known(way, low, high, humps) * size])
    hidden, which = torch.where(known > HIDDEN * highest, known.clamp(max=1.0), 0.0).max(0)
    longest = (high - low).argmax(-1)
    number = torch.where(which < 2, longest, which - 2)
    number = torch.where(hidden > 0, number, rough.argmax(-1))
    across = torch.nn.functional.one_hot(number, numbers).bool()
    # a narrower box holds a peak that float64 does not resolve
    wide = (high - low).where(across, 0.0).amax(-1) > 1e-13
    urgency = torch.maximum((sums[0] - sums[1]).abs(), hidden)
    return low, high, sums[0], torch.where(wide & urgency.isfinite(), urgency, 0.0), across


def _roughness(integrand: Tensor, points: int, numbers: int) -> Tensor:
    """Return the share of the integrand (box, node, rows) in the two highest polynomials of each number.

    The result has shape (box, rows, number). The nodes are too few in the number in which it is largest.
    """
    if numbers == 1:
        return torch.zeros_like(integrand[:, :1]).movedim(1, -1)
    grid = integrand.unflatten(1, (points, points))
    highest = _highest_polynomials(points)
    return torch.stack(
        [
            torch.einsum("kn,bnmr->bkmr", highest, grid).abs().sum((1, 2)),
            torch.einsum("kn,bmnr->bkmr", highest, grid).abs().sum((1, 2)),
        ],
        -1,
    )


def _highest_polynomials(points: int) -> Tensor:
    """Return the matrix (2, points) from node values to coefficients of the two highest Legendre polynomials."""
    node, weight = np.polynomial.legendre.leggauss(points)
    values = np.polynomial.legendre.legvander(node, points - 1)[:, -2:]
    found = weight[:, None] * values * np.arange(2 * points - 3, 2 * points, 2)
    return torch.from_numpy(np.ascontiguousarray(found.T))


def _known(way: _Map, low: Tensor, high: Tensor, humps: Tensor) -> Tensor:
    """Return the highest integrand that the density's peaks indicate in each box, (probe, box, rows).

    The first probe is the box's nearest point to each peak. For two numbers there are two more, which have one number
    of that point and the middle of the box in the other: a peak that is narrow in one number and broad in the other is
    a ridge, which also crosses boxes that hold no peak.
    """
    numbers = low.shape[-1]
    near = humps.unsqueeze(1).clamp(low, high)  # (peak, box, rows, number)
    middle = ((low + high) / 2).expand_as(near)
    probes = [near]
    for number in range(numbers if numbers > 1 else 0):
        here = torch.arange(numbers) == number
        probes.append(torch.where(here, near, middle))
    found = []
    for probe in probes:
        value, volume = way.to(probe.flatten(0, 1))
        found.append((way.log_prob(value).exp() * volume).reshape(near.shape[:-1]).nan_to_num().amax(0))
    return torch.stack(found)


def _gathered(way: _Map, low: Tensor, high: Tensor, mass: Tensor) -> Boxes:
    value, log_prob, weight = _nodes(way, low, high, RULES[low.shape[-1]][0])
    border = mass[:0]
    if low.shape[-1] == 1:
        order = (low + high)[..., 0].argsort(0)  # empty boxes come before those that begin at the same place
        mass = mass.gather(0, order)
        ends = torch.cat([low[..., 0].gather(0, order), high[..., 0].amax(0, keepdim=True)])
        border = way.to(ends.unsqueeze(-1))[0][..., 0]
    return Boxes(value, log_prob.flatten(0, 1), weight.flatten(0, 1), border, mass, way, low, high)
