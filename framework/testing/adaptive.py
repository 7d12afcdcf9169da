"""Adaptive quadrature of densities of one or two numbers: a box is split where two quadrature rules disagree."""

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
"""Gauss-Legendre points per side of a box in each of the two rules, by the dimension of the density.

A box on which the integrals by the two rules differ is split.
"""
TOLERANCE = {1: 1e-10, 2: 1e-9}
"""Largest difference of the two integrals over a box that is not split, by the dimension of the density.

The errors of many boxes add up, so that this bound is far below that of the whole integral.
"""
FAR = 16.0
"""Distance from the mode, in widths, at which the direction of the tails of a density of two numbers is tested."""
TOLERANCE_OF_MOMENTS = 1e-7
"""Largest difference of the two integrals of a moment over a box that is not split, relative to the moment."""
HEAVIEST = {1: 1.0, 2: 0.01}
"""Largest mass of a box that is not split, by the dimension of the density.

Draws of two numbers are counted in boxes, so that no box may hold a large share of them.
"""
ROUNDS = {1: 60, 2: 80}
"""Largest number of rounds, in each of which boxes are split, by the dimension of the density."""
MOST = {1: 128, 2: 48}
"""Largest number of boxes of one density that are split in one round, by the dimension of the density."""
MOST_PEAKS = 64
"""Largest number of `mode_candidates` of a density that are used."""
HIDDEN = 2.0
"""Ratio above which a box is split, since it may hide a peak.

It is the ratio of the integrand at a known point in the box to the largest integrand at the nodes of the box.
"""
UNSEEN_MASS = 1e-7
"""Mass of a box of two numbers that may be missing where a known peak differs from the interpolated integrand."""
RESOLVED = 1e-6
"""Largest rounding of values, in widths of the density, with which its integrals are compared."""
AT_ONCE = 4096
"""Number of values that are assigned to boxes at once."""
LARGEST_COORDINATE = 36.0
"""Largest coordinate s, where values are mode + a sinh(s) and a is the width of the density.

Densities of real numbers are integrated up to sinh 36 = 2e15 widths from the mode, densities of angles up to half a
turn from it.
"""


@dataclass(frozen=True)
class Boxes:
    """Boxes into which the domain of a density with batch_shape (rows,) was split, with their masses (probabilities).

    Attributes:
        value: Nodes of all boxes, which are the values at which the density is evaluated, (node, rows, number).
        log_prob: Log-density at `value`, (node, rows), nats.
        weight: Quadrature weight of each node, (node, rows); Σ weight · exp(log_prob) is the integral.
        border: Borders of the boxes, ascending, (box + 1, rows); empty for densities of two numbers.
        mass: Mass of each box, (box, rows).
        mapping: Map from coordinates to values. The boxes are rectangles in these coordinates.
        low, high: Lower and upper corners of the boxes in these coordinates, (box, rows, number).
        converged: Whether the two rules agree on the boxes of each density, (rows,). They may not for a density of two
            numbers with a peak that is narrower than another one by many orders of magnitude. Densities of one number
            count as converged.
    """

    value: Tensor
    log_prob: Tensor
    weight: Tensor
    border: Tensor
    mass: Tensor
    mapping: "_Map"
    low: Tensor
    high: Tensor
    converged: Tensor

    @property
    def resolved(self) -> Tensor:
        """Return whether values are rounded by much less than the width of the density, (rows,).

        Nothing can be said about the integrals of other densities, such as that of two numbers of size 1e14 whose
        difference has a standard deviation of 1e-4. Only densities of two correlated numbers are tested for this.
        """
        return self.mapping.rounding < RESOLVED

    def mean(self, integrand: Tensor) -> Tensor:
        """Return ∫ p f for the density p and a function f, (rows,).

        Args:
            integrand: Values of f at the nodes, (node, rows).
        """
        share = self.weight * self.log_prob.exp()
        return torch.where(share > 0, share * integrand, 0.0).sum(0)

    def entropy(self) -> Tensor:
        """Return the entropy, (rows,), nats."""
        return -self.mean(self.log_prob)

    def error_bound(self, function: Callable[[Tensor], Tensor]) -> Tensor:
        """Return a bound on the error of ∫ p f for the density p and a function f, (rows,).

        The integral has an error because the boxes were split for p and not for f, and because they end at a finite
        distance. The bound is the difference of the integrals by the two rules, plus a bound on the integral beyond the
        outermost boxes for tails that fall like a power.

        Args:
            function: f, a function of values of the density.
        """
        shares = []
        for points in RULES[self.low.shape[-1]]:
            value, log_prob, weight = _nodes(self.mapping, self.low, self.high, points)
            share = weight * log_prob.exp()
            part = torch.where(share > 0, share * function(value).reshape(share.shape), 0.0).sum(1)
            shares.append(part)
        rules = (shares[0] - shares[1]).abs().sum(0)
        if self.mapping.angles:
            return rules
        outermost = (self.low == self.mapping.ends[0]).any(-1) | (self.high == self.mapping.ends[1]).any(-1)
        return rules + 100 * torch.where(outermost, shares[0].abs(), 0.0).sum(0)

    def split_for(self, function: Callable[[Tensor], Tensor]) -> "Boxes":
        """Return boxes that are also split where the integral ∫ p f has an error.

        Boxes that are split for p alone are too large in heavy tails, where p is small and p f is not.

        Args:
            function: f ≥ 0, a function of values of the density.
        """
        numbers = self.low.shape[-1]

        def evaluate(low: Tensor, high: Tensor) -> tuple[Tensor, ...]:
            sums, masses, rough = [], [], torch.zeros_like(low)
            for points in RULES[numbers]:
                value, log_prob, weight = _nodes(self.mapping, low, high, points)
                mass = weight * log_prob.exp()
                share = torch.where(mass > 0, mass * function(value).reshape(mass.shape), 0.0)
                masses.append(mass.sum(1))
                sums.append(share.sum(1))
                if points == RULES[numbers][0]:
                    even = share / rule(points, numbers)[1][:, None]
                    rough = roughness(even.nan_to_num(), points, numbers)
            gap = (sums[0] - sums[1]).abs()
            can_split = gap.isfinite() & ((high - low).amax(-1) > 1e-13) & self.converged
            gap = torch.where(can_split, gap, 0.0)
            axis = torch.nn.functional.one_hot(rough.argmax(-1), numbers).bool()
            return low, high, masses[0], gap, axis, sums[0]

        parts = evaluate(self.low, self.high)
        for _ in range(ROUNDS[numbers]):
            split = int((parts[3] > TOLERANCE_OF_MOMENTS * parts[5].sum(0)).sum(0).max())
            if split == 0:
                break
            split = min(split, 2 * MOST[numbers])
            order = parts[3].argsort(0, descending=True)
            low, high, axis = (gather_boxes(parts[index], order[:split]) for index in (0, 1, 4))
            middle = torch.where(axis, (low + high) / 2, math.nan)
            fresh = evaluate(torch.cat([low, middle.fmax(low)]), torch.cat([middle.fmin(high), high]))
            parts = tuple(
                torch.cat([gather_boxes(old, order[split:]), new])
                for old, new in zip(parts, fresh, strict=True)
            )
        return _make_boxes(self.mapping, *parts[:3], converged=self.converged)

    def count(self, value: Tensor) -> Tensor:
        """Return the number of values in each box, (box, rows), float64; a value on a border counts for one box.

        Args:
            value: Values, (value, rows, number).
        """
        coordinates = self.mapping.coordinates(value)
        counts = torch.zeros_like(self.mass)
        for row in range(counts.shape[1]):
            low, high = self.low[:, row], self.high[:, row]
            for part in coordinates[:, row].split(AT_ONCE):
                inside = torch.ones(len(part), len(low), dtype=torch.bool)
                for number in range(low.shape[-1]):
                    place = part[:, number, None]
                    inside &= (place >= low[:, number]) & (place <= high[:, number])
                box = inside.int().argmax(1)
                counts[:, row].index_add_(0, box, torch.ones(len(part), dtype=torch.float64))
        return counts

    def mass_below(self, value: Tensor) -> Tensor:
        """Return the mass between the first border and each value, (value, rows), for densities of one number.

        For angles the first border is half a turn before the mode.

        Args:
            value: Values, (value, rows).
        """
        coordinates = self.mapping.coordinates(value.unsqueeze(-1))
        border = self.mapping.coordinates(self.border.unsqueeze(-1))[..., 0]
        border[0], border[-1] = (end[:, 0] for end in self.mapping.ends)
        box = torch.searchsorted(border.T.contiguous(), coordinates[..., 0].T.contiguous()).T.clamp(
            1, len(border) - 1
        )
        low = border.gather(0, box - 1).unsqueeze(-1)
        _, log_prob, weight = _nodes(self.mapping, low, coordinates, RULES[1][0])
        before = torch.cat([torch.zeros_like(self.mass[:1]), self.mass.cumsum(0)]).gather(0, box - 1)
        return before + (weight * log_prob.exp()).sum(1)


class _Map:
    """Map from the coordinates in which boxes are split to values: origin + width · sinh(coordinate) on each axis.

    The directions of the axes and the widths are estimated from the density.

    Args:
        density: Density with batch_shape (rows,).
        candidates: Values, (candidate, rows, number). The one with the highest density is the origin, since the mode
            that the density states may be wrong.
        peaks: Values, (peak, rows, number). For densities of two real numbers, the peak with the largest mass is the
            origin if its mass is above that around the highest value: the widths there are those of most of the mass,
            while the highest peak may be a narrow one with a small weight.
    """

    def __init__(self, density: Distribution, candidates: Tensor, peaks: Tensor) -> None:
        self.density = density
        height = self.log_prob(candidates)
        rows = torch.arange(candidates.shape[1])
        best = height.where(~height.isnan(), -math.inf).argmax(0)
        self.mode = candidates[best, rows]
        self.angles = isinstance(density.support, Circular)
        self.has_ranges = isinstance(density.support, Circular) and density.support.ranges is not None
        if self.has_ranges:
            self.mode = wrap(self.mode)
        self.scale = self.widths(self.mode)
        if not self.angles and self.mode.shape[1] == 2:
            origins = torch.cat([self.mode.unsqueeze(0), peaks])
            scales = torch.stack([self.scale, *map(self.widths, peaks)])
            log_mass = self.log_prob(origins) + scales.log().sum(-1)
            # another peak must have clearly more mass, so that equal peaks leave the origin where it is
            log_mass[1:] -= math.log(2)
            most = log_mass.where(~log_mass.isnan(), -math.inf).argmax(0)
            self.mode, self.scale = origins[most, rows], scales[most, rows]
        self.slope = torch.zeros_like(self.mode[:, 0])
        if not self.angles and self.mode.shape[1] == 2:
            self._whiten()
        end = torch.full_like(self.mode, LARGEST_COORDINATE)
        self.ends = -end, end
        if isinstance(density.support, Circular):
            whole_turn = [(-math.pi, math.pi)] * self.mode.shape[1]
            first, last = torch.tensor(density.support.ranges or whole_turn, dtype=torch.float64).T
            if density.support.ranges is None:
                first, last = first + self.mode, last + self.mode
            self.ends = ((first - self.mode) / self.scale).asinh(), ((last - self.mode) / self.scale).asinh()

    @property
    def rounding(self) -> Tensor:
        """Return the rounding of typical values of two correlated numbers, in widths of the second one, (rows,).

        The width is that of the second number if the first one is known.
        """
        if self.mode.shape[1] == 1:
            return torch.zeros_like(self.slope)
        size = self.mode.abs() + 3 * self.scale
        along = self.slope.abs() * size[:, 0]
        rounding = torch.finfo(torch.float64).eps * (size[:, 1] + 2 * along) / self.scale[:, 1]
        return rounding.where(self.slope != 0, 0.0)

    def log_prob(self, value: Tensor) -> Tensor:
        like = self.density.sample(torch.Size((0,)))
        return self.density.log_prob(value.to(like.dtype)).double()

    def widths(self, peak: Tensor) -> Tensor:
        """Return the distance from a peak along each axis at which log p has fallen by half a nat, (rows, number)."""
        steps = 2.0 ** torch.arange(-40, 2 if self.angles else 60, dtype=torch.float64)
        top = self.log_prob(peak)
        widths = []
        for number in range(peak.shape[1]):
            axis = torch.zeros(peak.shape[1], dtype=torch.float64)
            axis[number] = 1
            values = peak + steps[:, None, None] * axis
            fallen = (top - self.log_prob(values) > 0.5).int()
            first = torch.where(
                fallen.amax(0) > 0, fallen.argmax(0), 40
            )  # width 2^0 = 1 where p does not fall
            widths.append(steps[first])
        return torch.stack(widths, -1)

    def _whiten(self) -> None:
        """Set `slope`: the change of the most likely second number per change of the first number.

        The slope is estimated by mixed second differences of log p, one width apart. It is 0 where log p falls faster
        along it than along the axis: the numbers of a mixture of independent numbers are correlated at the mode, but
        its tails follow the axes. The width of the first number is then measured along this slope.
        """
        first, second = self.scale[:, 0], self.scale[:, 1]
        corner = {}
        for first_sign, second_sign in product((-1, 0, 1), repeat=2):
            offset = torch.stack([first_sign * first, second_sign * second], -1)
            corner[first_sign, second_sign] = self.log_prob(self.mode + offset)
        mixed = (corner[1, 1] - corner[1, -1] - corner[-1, 1] + corner[-1, -1]) / 4
        bend = corner[0, 1] + corner[0, -1] - 2 * corner[0, 0]
        slope = -mixed / bend * second / first
        slope = torch.where(slope.isfinite(), slope, 0.0)
        both_ways = torch.tensor([[[-FAR]], [[FAR]]], dtype=torch.float64)
        along_axis, along_slope = (
            self.log_prob(self.mode + both_ways * torch.stack([first, factor * first], -1)).sum(0)
            for factor in (torch.zeros_like(slope), slope)
        )
        self.slope = torch.where(along_axis > along_slope, 0.0, slope)
        # along the conditional mode of the second number the width of the first is that of its marginal
        steps = 2.0 ** torch.arange(0, 60, dtype=torch.float64)
        offset = torch.stack([first, self.slope * first], -1)
        fallen = (corner[0, 0] - self.log_prob(self.mode + steps[:, None, None] * offset) > 0.5).int()
        wider = torch.where(fallen.amax(0) > 0, steps[fallen.argmax(0)], 1.0)
        self.scale = torch.stack([first * wider, second], -1)

    def values_and_volumes(self, coordinates: Tensor) -> tuple[Tensor, Tensor]:
        """Return the values at coordinates (node, rows, number), and the volume element of the map, (node, rows)."""
        offset = self.scale * coordinates.sinh()
        volume = (self.scale * coordinates.cosh()).prod(-1)
        if coordinates.shape[-1] == 2:
            offset = torch.stack([offset[..., 0], offset[..., 1] + self.slope * offset[..., 0]], -1)
        return self.mode + offset, volume

    def coordinates(self, value: Tensor) -> Tensor:
        """Return the coordinates of values, both (..., rows, number)."""
        offset = (wrap(value.double()) if self.has_ranges else value.double()) - self.mode
        if self.angles and not self.has_ranges:
            offset = wrap(offset)
        if offset.shape[-1] == 2:
            offset = torch.stack([offset[..., 0], offset[..., 1] - self.slope * offset[..., 0]], -1)
        return (offset / self.scale).asinh().clamp(*self.ends)


def rule(points: int, numbers: int) -> tuple[Tensor, Tensor]:
    """Return nodes (points^numbers, numbers) and weights of the Gauss-Legendre rule in the unit box."""
    node, weight = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(points))
    nodes = torch.cartesian_prod(*[(node + 1) / 2] * numbers).reshape(-1, numbers)
    weights = torch.cartesian_prod(*[weight / 2] * numbers).reshape(-1, numbers).prod(-1)
    return nodes, weights


@lru_cache(maxsize=4)
def boxes(density: Distribution) -> Boxes:
    """Integrate a density of one or two numbers, batch_shape (rows,): split boxes until two rules agree on each.

    A box is also split while it may hide a peak or a ridge of the density. Peaks are searched for at the mode, at the
    values that `mode_candidates` returns, and at draws.
    """
    peak_values = mode_candidates(density)[:MOST_PEAKS].double()
    draws = density.sample(torch.Size((24,))).double()
    candidates = torch.cat([density.mode.unsqueeze(0).double(), peak_values, draws])
    mapping = _Map(density, candidates, peak_values)
    peak_coordinates = mapping.coordinates(peak_values)
    numbers = mapping.mode.shape[1]
    candidate_log_prob = mapping.log_prob(candidates)
    candidate_coordinates = mapping.coordinates(candidates)
    side = 8 if numbers == 1 else 4
    cut = torch.linspace(0, 1, side + 1, dtype=torch.float64)
    length = mapping.ends[1] - mapping.ends[0]
    low = mapping.ends[0] + torch.cartesian_prod(*[cut[:-1]] * numbers).reshape(-1, 1, numbers) * length
    high = mapping.ends[0] + torch.cartesian_prod(*[cut[1:]] * numbers).reshape(-1, 1, numbers) * length
    if numbers == 1:
        # A kink at a peak near a border may lie beyond the outermost nodes of both rules, so a border is put there.
        shape = peak_coordinates.shape[1:]
        edges = torch.cat([low.expand(-1, *shape), high[-1:].expand(-1, *shape), peak_coordinates])
        edges = edges.sort(0).values
        low, high = edges[:-1], edges[1:]
    parts = _evaluate_boxes(mapping, low, high, candidate_coordinates, candidate_log_prob, peak_coordinates)
    # float32 does not reproduce more digits
    tolerance = TOLERANCE[numbers] if density.log_prob(density.mode).dtype == torch.float64 else 1e-4
    for _ in range(ROUNDS[numbers]):
        split = int((parts[3] > tolerance).sum(0).max())
        if split == 0:
            break
        split = min(split, MOST[numbers])
        order = parts[3].argsort(0, descending=True)
        low, high, split_axis = (gather_boxes(parts[index], order[:split]) for index in (0, 1, 4))
        middle = torch.where(split_axis, (low + high) / 2, math.nan)
        halves = torch.cat([low, middle.fmax(low)]), torch.cat([middle.fmin(high), high])
        fresh = _evaluate_boxes(mapping, *halves, candidate_coordinates, candidate_log_prob, peak_coordinates)
        parts = tuple(
            torch.cat([gather_boxes(old, order[split:]), new]) for old, new in zip(parts, fresh, strict=True)
        )
    open_urgency = parts[3].where(parts[3] > tolerance, 0.0).sum(0)
    return _make_boxes(mapping, *parts[:3], converged=(open_urgency < UNSEEN_MASS) | (numbers == 1))


def gather_boxes(part: Tensor, index: Tensor) -> Tensor:
    """Return the boxes with the indices `index` from a tensor of boxes.

    Args:
        part: Tensor (box, rows, ...).
        index: Indices of boxes, (chosen box, rows).
    """
    if part.dim() == 3:
        index = index.unsqueeze(-1).expand(*index.shape, part.shape[-1])
    return part.gather(0, index)


def _nodes(mapping: _Map, low: Tensor, high: Tensor, points: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the nodes of boxes (box · node, rows, number), and their log-densities and weights, (box, node, rows).

    Args:
        mapping: Map from coordinates to values.
        low: Lower corners of the boxes, in coordinates.
        high: Upper corners of the boxes, in coordinates.
        points: Gauss-Legendre points per side.
    """
    nodes, weights = rule(points, low.shape[-1])
    coordinates = low.unsqueeze(1) + (high - low).unsqueeze(1) * nodes[:, None]
    value, volume = mapping.values_and_volumes(coordinates.flatten(0, 1))
    shape = (low.shape[0], len(nodes), low.shape[1])
    weight = volume.reshape(shape) * weights[:, None] * (high - low).prod(-1).unsqueeze(1)
    return value, mapping.log_prob(value).reshape(shape), weight


def _evaluate_boxes(
    mapping: _Map,
    low: Tensor,
    high: Tensor,
    candidate_coordinates: Tensor,
    candidate_log_prob: Tensor,
    peak_coordinates: Tensor,
) -> tuple[Tensor, ...]:
    """Return the corners of boxes, their masses, the urgency to split each, and the axis along which to split it.

    The corners are `low` and `high`. Masses and urgency have shape (box, rows). The axis is a mask (box, rows, number).
    The urgency is the difference of the integrals by two quadrature rules. The urgency is raised if the integrand at a
    candidate or near a known peak is far above the integrand at every node. It is also raised if the integrand at a
    known peak differs from its extrapolation from the nodes, or if the mass of the box is above `HEAVIEST`.

    Args:
        mapping: Map from coordinates to values.
        low: Lower corners, in coordinates.
        high: Upper corners, in coordinates.
        candidate_coordinates: Coordinates of values where the density may be high.
        candidate_log_prob: Log-densities there.
        peak_coordinates: Coordinates of the `mode_candidates`.
    """
    numbers = low.shape[-1]
    sums, highest, rough = [], torch.zeros_like(low[..., 0]), torch.zeros_like(low)
    for points in RULES[numbers]:
        _, log_prob, weight = _nodes(mapping, low, high, points)
        share = weight * log_prob.exp()
        sums.append(share.sum(1))
        # mass of the box if the integrand were everywhere as high as at this node
        even = share / rule(points, numbers)[1][:, None]
        highest = torch.maximum(highest, even.nan_to_num().amax(1))
        if points == RULES[numbers][0]:
            rough = roughness(even.nan_to_num(), points, numbers)
            unlike = _unlike_peaks(mapping, low, high, even.nan_to_num(), points, peak_coordinates)
    size = (high - low).prod(-1)
    point = candidate_coordinates.unsqueeze(1)
    inside = ((point >= low) & (point <= high)).all(-1)  # (candidate, box, rows)
    _, volume = mapping.values_and_volumes(candidate_coordinates)
    peak = torch.where(inside, (candidate_log_prob.exp() * volume).unsqueeze(1), 0.0).amax(0) * size
    # a box with a peak in it or near it is split along its longest axis, a box with a ridge across the ridge
    largest = torch.cat(
        [peak.unsqueeze(0), _integrands_near_peaks(mapping, low, high, peak_coordinates) * size]
    )
    hidden, which = torch.where(largest > HIDDEN * highest, largest.clamp(max=1.0), 0.0).max(0)
    longest = (high - low).argmax(-1)
    number = torch.where(which < 2, longest, which - 2)
    number = torch.where(hidden > 0, number, rough.argmax(-1))
    split_axis = torch.nn.functional.one_hot(number, numbers).bool()
    # float64 does not resolve a peak in a narrower box
    wide = (high - low).where(split_axis, 0.0).amax(-1) > 1e-13
    heavy = torch.where(sums[0] > HEAVIEST[numbers], sums[0].clamp(max=1.0), 0.0)
    urgency = torch.maximum((sums[0] - sums[1]).abs(), hidden).fmax(unlike).fmax(heavy)
    return low, high, sums[0], torch.where(wide & urgency.isfinite(), urgency, 0.0), split_axis


def roughness(integrand: Tensor, points: int, numbers: int) -> Tensor:
    """Return a measure of how rough the integrand is along each axis of each box, (box, rows, axis); 0 for one axis.

    The measure is the size of the integrand's part in the two highest Legendre polynomials along the axis. A box is
    split along the axis with the largest measure, unless the box may hide a peak.

    Args:
        integrand: Integrand at the nodes, (box, node, rows).
        points: Nodes per side.
        numbers: Dimension of the density.
    """
    if numbers == 1:
        return torch.zeros_like(integrand[:, :1]).movedim(1, -1)
    grid = integrand.unflatten(1, (points,) * numbers)
    highest = _highest_polynomials(points)
    along = [grid.movedim(1 + number, -1) @ highest.T for number in range(numbers)]
    # each part is (box, other nodes, rows, coefficient)
    return torch.stack([part.abs().sum((*range(1, numbers), -1)) for part in along], -1)


def _unlike_peaks(
    mapping: _Map, low: Tensor, high: Tensor, integrand: Tensor, points: int, peak_coordinates: Tensor
) -> Tensor:
    """Return by how much the integrand at known peaks differs from its interpolation, (box, rows).

    A difference shows a peak that is too narrow for the nodes and too low to be far above the integrand beside it, such
    as that of a component of small weight. For one number, peaks lie on borders of boxes.

    Args:
        mapping: Map from coordinates to values.
        low: Lower ends of the boxes, in coordinates.
        high: Upper ends of the boxes, in coordinates.
        integrand: Integrand at the nodes, times the size of the box, (box, node, rows).
        points: Nodes per side.
        peak_coordinates: Coordinates of the known peaks.
    """
    unlike = torch.zeros_like(low[..., 0])
    if not len(peak_coordinates):
        return unlike
    if low.shape[-1] == 2:
        return _unlike_peaks_and_ridges(mapping, low, high, integrand, points, peak_coordinates)
    value, volume = mapping.values_and_volumes(peak_coordinates)
    at_peak = (mapping.log_prob(value).exp() * volume).unsqueeze(1).nan_to_num() * (high - low)[..., 0]
    node, _ = np.polynomial.legendre.leggauss(points)
    inverse = np.linalg.inv(np.polynomial.legendre.legvander(node, points - 1))
    for end, border in ((-1.0, low), (1.0, high)):
        weight = torch.from_numpy(np.polynomial.legendre.legvander(np.array([end]), points - 1)[0] @ inverse)
        expected = torch.einsum("n,bnr->br", weight, integrand)
        is_border = (peak_coordinates.unsqueeze(1) == border)[..., 0]
        unlike = torch.maximum(unlike, torch.where(is_border, (at_peak - expected).abs(), 0.0).amax(0))
    return unlike.clamp(max=1.0)


def _unlike_peaks_and_ridges(
    mapping: _Map, low: Tensor, high: Tensor, integrand: Tensor, points: int, peak_coordinates: Tensor
) -> Tensor:
    """Return by how much the integrand in a box differs from its interpolation at known peaks and ridges, (box, rows).

    The function is `_unlike_peaks` for densities of two numbers. A ridge is compared where it crosses the middle of the
    box. Differences below `UNSEEN_MASS` are 0, because quadrature is far more exact than interpolation.
    """
    grid = integrand.unflatten(1, (points, points))
    node, _ = np.polynomial.legendre.leggauss(points)
    inverse = torch.from_numpy(np.linalg.inv(np.polynomial.legendre.legvander(node, points - 1)))
    unlike = torch.zeros_like(low[..., 0])
    middle, size = (low + high) / 2, (high - low).clamp(min=1e-300)
    for peak in peak_coordinates:
        at = peak.expand_as(low)
        within = (at >= low) & (at <= high)
        for on_peak in ([True, True], [True, False], [False, True]):
            chosen = torch.tensor(on_peak)
            crossed = (within | ~chosen).all(-1)
            if not bool(crossed.any()):
                continue
            probe = torch.where(chosen & within, at, middle)
            unit = 2 * (probe - low) / size - 1
            polynomials = [torch.ones_like(unit), unit]
            for degree in range(1, points - 1):
                polynomials.append(
                    ((2 * degree + 1) * unit * polynomials[-1] - degree * polynomials[-2]) / (degree + 1)
                )
            weight = torch.stack(polynomials, -1) @ inverse  # (box, rows, number, node)
            expected = torch.einsum("brn,brm,bnmr->br", weight[:, :, 0], weight[:, :, 1], grid)
            value, volume = mapping.values_and_volumes(probe)
            height = (mapping.log_prob(value).exp() * volume).nan_to_num() * (high - low).prod(-1)
            unlike = torch.where(crossed, torch.maximum(unlike, (height - expected).abs()), unlike)
    return torch.where(unlike > UNSEEN_MASS, unlike, 0.0).clamp(max=1.0)


def _highest_polynomials(points: int) -> Tensor:
    """Return a matrix (2, points): it maps values at `points` nodes to coefficients of the two highest polynomials.

    The polynomials are Legendre's, of degree points - 2 and points - 1.
    """
    node, weight = np.polynomial.legendre.leggauss(points)
    values = np.polynomial.legendre.legvander(node, points - 1)[:, -2:]
    matrix = weight[:, None] * values * np.arange(2 * points - 3, 2 * points, 2)
    return torch.from_numpy(np.ascontiguousarray(matrix.T))


def _integrands_near_peaks(mapping: _Map, low: Tensor, high: Tensor, peak_coordinates: Tensor) -> Tensor:
    """Return the largest integrand in each box at points that are close to known peaks, (probe, box, rows).

    A probe is a kind of such points. The first probe is the point of the box that is nearest to a peak. Densities of
    two numbers have two more probes: one coordinate is that of the nearest point, and the other is the middle of the
    box. These detect a ridge: a peak that is narrow in one number and broad in the other. A ridge also crosses boxes
    that contain no peak.

    Args:
        mapping: Map from coordinates to values.
        low: Lower corners of the boxes, in coordinates.
        high: Upper corners of the boxes, in coordinates.
        peak_coordinates: Coordinates of the known peaks.
    """
    numbers = low.shape[-1]
    near = peak_coordinates.unsqueeze(1).clamp(low, high)  # (peak, box, rows, number)
    middle = ((low + high) / 2).expand_as(near)
    probes = [near]
    for number in range(numbers if numbers > 1 else 0):
        is_number = torch.arange(numbers) == number
        probes.append(torch.where(is_number, near, middle))
    highest = []
    for probe in probes:
        value, volume = mapping.values_and_volumes(probe.flatten(0, 1))
        highest.append((mapping.log_prob(value).exp() * volume).reshape(near.shape[:-1]).nan_to_num().amax(0))
    return torch.stack(highest)


def _make_boxes(mapping: _Map, low: Tensor, high: Tensor, mass: Tensor, *, converged: Tensor) -> Boxes:
    value, log_prob, weight = _nodes(mapping, low, high, RULES[low.shape[-1]][0])
    border = mass[:0]
    if low.shape[-1] == 1:
        order = (low + high)[..., 0].argsort(
            0
        )  # empty boxes come before those that begin at the same coordinate
        mass = mass.gather(0, order)
        ends = torch.cat([low[..., 0].gather(0, order), high[..., 0].amax(0, keepdim=True)])
        border = mapping.values_and_volumes(ends.unsqueeze(-1))[0][..., 0]
    return Boxes(
        value, log_prob.flatten(0, 1), weight.flatten(0, 1), border, mass, mapping, low, high, converged
    )
