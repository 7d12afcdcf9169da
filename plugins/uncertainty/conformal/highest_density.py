"""Level sets of the density of one number: their ends, their probabilities, and nodes that resolve peaks of any width.

A level set holds all values whose log-density is at least a level. A hump is a region around a local maximum of the
density. A cell is the interval between two neighbouring nodes.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.batch_shapes import Reshaped
from framework.distributions.circular import Circular, grid, wrap
from framework.distributions.panels import first_in_cell, known_scales
from framework.distributions.protocol import mode_candidates

FOLD = 12
"""Number of nodes per factor e of the distance from a peak: the distance grows by 8 % from node to node."""
NEAREST, FARTHEST = 1e-11, 1e11
"""Smallest and largest distance of nodes from a peak, as multiples of `_unit`; the largest is π for angles."""
TURN = 720
"""Number of additional nodes, evenly spaced on the circle, for broad humps without a mode candidate."""
PEAKS, CANDIDATES = 8, 64
"""Largest number of peaks that have nodes of their own, and of mode candidates among which they are chosen."""
PARTED = 0.1
"""Smallest depth, nats, of a valley that separates two humps; shallower ones count as part of one hump."""
BISECTIONS = 52
"""Number of halvings of the interval between two nodes; the ends of level sets are then as exact as the dtype."""


@dataclass(frozen=True)
class Ends:
    """Intervals in which the log-density of one number is at least a level.

    Attributes:
        length: total length of the intervals of each item, (item,), float64.
        intervals: for each item, the ends (low, high) of its intervals, in ascending order.
    """

    length: Float[Tensor, "item"]
    intervals: list[list[tuple[float, float]]]


class Line:
    """The density p of one number, evaluated at nodes whose distances from its peaks have all orders of magnitude.

    Their distances are multiples of the width of the peaks, so that they do not depend on the unit of a real number.
    For peaks of different widths, the nodes resolve a standard deviation of 1e-9 as well as one of 1e9. Between two
    nodes, log p is taken to be linear.

    Args:
        density: density of one real number or angle, event_shape (1,). It may have any batch_shape; the elements of the
            flattened batch are the items.
    """

    def __init__(self, density: Distribution) -> None:
        self.items = density.batch_shape.numel()
        self.density = density if len(density.batch_shape) == 1 else Reshaped(density, (self.items,))
        support = density.support
        self.range: tuple[float, float] = (-math.inf, math.inf)
        self.closed = False
        if isinstance(support, Circular):
            self.closed = support.ranges is None
            self.range = (-math.pi, math.pi) if support.ranges is None else support.ranges[0]
        like = density.sample(torch.Size((0,)))
        self.dtype, self.device = like.dtype, like.device
        empty = torch.zeros(2, 0, dtype=torch.float64, device=self.device)
        self.nodes = self._nodes() if self.items else empty
        self.heights = self.at(self.nodes) if self.items else empty
        self._low, self._high, self._log_width = self._cells()
        self._log_whole = self._log_less(torch.full_like(self.heights[0], math.inf))

    def at(self, places: Float[Tensor, "place item"]) -> Float[Tensor, "place item"]:
        """Return log p at `places`, nats, float64."""
        return self.density.log_prob(places.to(self.dtype).unsqueeze(-1)).double()

    def score_of(self, level: Float[Tensor, "item"]) -> Float[Tensor, "item"]:
        """Return -log of the probability of all values whose log-density is below `level`, nats, at least 0.

        The score falls as the level rises.
        """
        return (self._log_whole - self._log_less(level)).clamp(min=0)

    def level_of(self, score: Float[Tensor, ""]) -> Float[Tensor, "item"]:
        """Return for each item the level of the log-density at which `score_of` equals `score`, with an error of 1e-12.

        The equation is solved by regula falsi in the Illinois variant.
        """
        high, reach = self.heights.amax(0), score.clamp(min=0) + 1
        if score < 0:  # no score is negative
            return torch.full_like(high, math.inf)
        over_high = self.score_of(high) - score
        low = high - reach
        over_low = self.score_of(low) - score
        while bool((over_low < 0).any()):  # terminates: below every node the score is infinite
            reach = 2 * reach
            low = torch.where(over_low < 0, high - reach, low)
            over_low = self.score_of(low) - score
        last = torch.zeros_like(high)
        for _ in range(200):
            difference = over_low - over_high
            middle = torch.where(
                difference.isfinite() & (difference > 0),
                (low * -over_high + high * over_low) / difference,
                (low + high) / 2,
            )
            middle = middle.clamp(low, high)
            over = self.score_of(middle) - score
            if not ((over.abs() > 1e-12 * (1 + score)) & (high - low > 1e-14 * (1 + high.abs()))).any():
                return middle
            above = over > 0
            # if an end of the bracket stays twice, its value is halved, so that the next step moves this end
            over_high = torch.where(above & (last > 0), over_high / 2, over_high)
            over_low = torch.where(~above & (last < 0), over_low / 2, over_low)
            low, over_low = torch.where(above, middle, low), torch.where(above, over, over_low)
            high, over_high = torch.where(above, high, middle), torch.where(above, over_high, over)
            last = torch.where(above, 1.0, -1.0)
        return high

    def ends(self, level: Float[Tensor, "item"]) -> Ends:
        """Return the intervals of each item in which log p ≥ level.

        An item whose log p is NaN has no intervals and the length NaN.
        """
        inside = self.heights >= level
        start, stop = self.nodes, self.nodes.roll(-1, 0)
        following = inside.roll(-1, 0)
        if self.closed:
            stop = torch.cat([stop[:-1], stop[-1:] + 2 * math.pi])
        else:
            start, stop, before, following = start[:-1], stop[:-1], inside[:-1], following[:-1]
        before = inside if self.closed else inside[:-1]
        change = before != following
        places = self._crossings(change, start, stop, before, level)
        broken = self.heights.isnan().any(0).tolist()
        intervals = [
            [] if wrong else self._pair_ends(*crossing, bool(first), bool(last))
            for crossing, first, last, wrong in zip(places, inside[0], inside[-1], broken, strict=True)
        ]
        lengths = [
            math.nan if wrong else sum(high - low for low, high in parts)
            for parts, wrong in zip(intervals, broken, strict=True)
        ]
        return Ends(torch.tensor(lengths, dtype=torch.float64, device=self.device), intervals)

    def _crossings(
        self, change: Bool[Tensor, "cell item"], start: Tensor, stop: Tensor, before: Tensor, level: Tensor
    ) -> list[tuple[list[float], list[bool]]]:
        """Return for each item the positions at which log p crosses the level, ascending, and whether it rises there.

        Args:
            change: whether the level lies between the values of log p at the two ends of a cell.
            start: lower end of each cell.
            stop: upper end of each cell.
            before: whether log p at the lower end is at least the level.
            level: the level of each item.
        """
        most = int(change.sum(0).amax()) if change.numel() else 0
        # the changed cells of each item first, in order
        order = change.to(torch.int8).sort(dim=0, descending=True, stable=True).indices[:most]
        low, high, leaves = (cells.gather(0, order) for cells in (start, stop, before))
        for _ in range(BISECTIONS if most else 0):  # torch's Independent refuses an empty tensor
            middle = (low + high) / 2
            same = (self.at(middle) >= level) == leaves
            low, high = torch.where(same, middle, low), torch.where(same, high, middle)
        counts = change.sum(0).tolist()
        middles, rising = ((low + high) / 2).T.tolist(), (~leaves).T.tolist()
        return [(places[:n], up[:n]) for places, up, n in zip(middles, rising, counts, strict=True)]

    def _pair_ends(
        self, places: list[float], rising: list[bool], first: bool, last: bool
    ) -> list[tuple[float, float]]:
        """Return the intervals of one item in which log p is at least the level.

        Args:
            places: positions at which log p crosses the level, ascending.
            rising: whether log p rises there.
            first: whether log p is at least the level at the first node.
            last: whether log p is at least the level at the last node.
        """
        if not places:
            return [self.range] if first else []
        lows = [place for place, up in zip(places, rising, strict=True) if up]
        highs = [place for place, up in zip(places, rising, strict=True) if not up]
        if not self.closed:
            lows = [self.range[0], *lows] if first else lows
            highs = [*highs, self.range[1]] if last else highs
            return list(zip(lows, highs, strict=True))
        turn = 2 * math.pi
        if highs[0] < lows[0]:  # an arc across ±π
            highs = [*highs[1:], highs[0] + turn]
        arcs = [
            (low - turn, high - turn) if low >= math.pi else (low, high)
            for low, high in zip(lows, highs, strict=True)
        ]
        return sorted(arcs)

    def _nodes(self) -> Float[Tensor, "node item"]:
        places = self._peaks()  # (peak, item)
        farthest = math.pi if math.isfinite(self.range[1]) else FARTHEST
        count = math.ceil(FOLD * math.log(farthest / NEAREST))
        steps = torch.logspace(
            math.log10(NEAREST), math.log10(farthest), count, dtype=torch.float64, device=self.device
        )
        steps = torch.cat([-steps.flip(0), steps.new_zeros(1), steps]).reshape(-1, 1, 1)
        if math.isinf(self.range[1]):
            largest = torch.finfo(self.dtype).max / 4  # infinite nodes have no log-density
            steps = (steps * self._unit()).clamp(-largest, largest)
        nodes = (places + steps).flatten(0, 1)
        if math.isfinite(self.range[1]):
            low, high = self.range
            turn = grid(TURN, dtype=torch.float64, device=self.device) / (2 * math.pi)
            around = (low + high) / 2 + turn * (high - low)
            ends = around.new_tensor([low, high])[: 1 if self.closed else 2]
            around = torch.cat([around, ends])
            nodes = torch.cat([nodes, around.unsqueeze(-1).expand(-1, self.items)])
            nodes = wrap(nodes) if self.closed else nodes.clamp(low, high)
        # rounded to the dtype in which the density reads them; a closed circle has no second end
        return nodes.to(self.dtype).double().sort(0).values

    def _unit(self) -> Float[Tensor, "item"]:
        """Return the geometric mean of the smallest and of the largest peak width of each item."""
        widths = known_scales(self.density).log()
        return ((widths.amin(0) + widths.amax(0)) / 2).exp()

    def _peaks(self) -> Float[Tensor, "peak item"]:
        """Return the positions of the highest humps, at most PEAKS of each item.

        They are chosen among the mode candidates, the highest first. A candidate that no valley (PARTED) separates from
        a chosen one is on the same hump and is skipped.
        """
        places = self._candidates()  # (candidate, item), ascending; the last ones may repeat
        heights = self.at(places).nan_to_num(nan=-math.inf)
        tops = self._tops(places, heights)
        keep = heights.where(tops, -math.inf).topk(min(CANDIDATES, len(heights)), dim=0)
        places, heights = places.gather(0, keep.indices), keep.values
        chosen: list[Tensor] = []
        left = heights > -math.inf
        left[:1] = True
        while len(chosen) < PEAKS and bool(left.any()):
            best = heights.where(left, -math.inf).argmax(0, keepdim=True)
            place = places.gather(0, best)
            chosen.append(place)
            away = places - place
            away = wrap(away) if self.closed else away
            valley = self.at(place + away / 2)
            left &= ~(valley >= heights - PARTED)
            left.scatter_(0, best, False)
        return torch.cat(chosen)

    def _candidates(self) -> Float[Tensor, "candidate item"]:
        """Return mode candidates of each item in ascending order, at most one in each quarter of a peak width.

        Without this selection, hundreds of candidates may lie on one hump. An item with fewer candidates than others
        repeats its last one.
        """
        places = mode_candidates(self.density).squeeze(-1).double()
        if self.closed:
            places = wrap(places)
        order = places.sort(0)
        places, scale = order.values, known_scales(self.density).gather(0, order.indices)
        new = first_in_cell(places, scale, 0.25)
        most = int(new.sum(0).amax())
        first = new.to(torch.int8).sort(dim=0, descending=True, stable=True).indices[:most]
        # if an item has fewer candidates than `most`, its last candidate is repeated
        last = first.gather(0, new.sum(0, keepdim=True) - 1)
        first = torch.where(new.gather(0, first), first, last)
        return places.gather(0, first)

    def _tops(
        self, places: Float[Tensor, "candidate item"], heights: Float[Tensor, "candidate item"]
    ) -> Bool[Tensor, "candidate item"]:
        """Return for each candidate whether it may be the highest one on its hump, the region around a local maximum.

        It may be if each of its two neighbours is lower, or is separated from it by a valley (PARTED). The candidates
        are in ascending order of position.
        """
        ahead = places.roll(-1, 0) - places
        ahead = wrap(ahead) if self.closed else ahead
        valley = self.at(places + ahead / 2)
        after, before = heights.roll(-1, 0), heights.roll(1, 0)
        parted = valley < torch.minimum(heights, after) - PARTED
        tops = ((heights > before) | parted.roll(1, 0)) & ((heights >= after) | parted)
        if not self.closed:
            tops[:1] = (heights[:1] >= after[:1]) | parted[:1]
            tops[-1:] = (heights[-1:] > before[-1:]) | parted.roll(1, 0)[-1:]
        return tops.scatter(0, heights.argmax(0, keepdim=True), True)

    def _cells(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return, for each cell, the lower and the higher log p of its two ends, and the log of its width."""
        ahead, heights = self.nodes.roll(-1, 0), self.heights.roll(-1, 0)
        width = ahead - self.nodes
        if self.closed:
            width = torch.cat([width[:-1], width[-1:] + 2 * math.pi])
        else:
            width, heights = width[:-1], heights[:-1]
        lower_end = self.heights[: len(heights)]
        high = torch.maximum(lower_end, heights)
        low = torch.minimum(lower_end, heights).nan_to_num(nan=math.nan, neginf=-1e300)
        return low, high, width.log()

    def _log_less(self, level: Float[Tensor, "item"]) -> Float[Tensor, "item"]:
        """Return the log of the probability of all values whose log-density is below `level`, (item,).

        log p is linear in each cell; `low` and `high` are its lower and its higher value at the two ends of the cell.
        The part of the cell in which log p is below the level therefore has the probability (exp(c) - exp(low)) /
        (high - low), times the cell's width, with c = min(level, high).
        """
        top = torch.minimum(level, self._high)
        rise, fall = top - self._low, self._high - self._low
        sloped = self._log_width + top + (-torch.expm1(-rise)).log() - fall.log()
        level_cell = torch.where(level > self._high, self._log_width + self._high, -math.inf)
        mass = torch.where(fall > 0, sloped.where(rise > 0, -math.inf), level_cell)
        return mass.where(~self._high.isnan(), math.nan).logsumexp(0)
