"""The entropy of a density of one number, by quadrature on panels that follow its peaks, however narrow they are."""

import logging
import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.distributions.batch_shapes import Reshaped
from framework.distributions.circular import Circular, wrap
from framework.distributions.protocol import mode_candidates, peak_widths, recentre

AT_ONCE = 2**17
"""Largest number of component densities evaluated at once, and of pairs of peaks that are compared at once."""
WIDTH = 2.0
"""Width of a panel before it is halved, in the variable v of `Panels`.

The innermost panel ends 3.6 peak widths from its peak. Each further panel ends about e² times as far from it.
"""
REACH = 1e4
"""Distance from the outermost peak at which integration over the real line ends, in multiples of the largest width."""
ROUNDS, MOST = 40, 4096
"""Largest number of times that a panel is halved, and of panels of one density that are halved at once.

If a density needs more, the integral of the density differs from 1, which `entropy_of_one` detects.
"""
TOLERANCE = {torch.float64: 1e-9, torch.float32: 1e-6}
"""Largest difference between Kronrod's and Gauss's rule on a panel that is not halved, by the density's number type.

The error of Kronrod's rule, which gives the entropy, is far smaller than this difference.
"""
MASS_GAP = 100
"""Largest accepted difference between 1 and the integral of a density over its panels, in multiples of TOLERANCE."""
LARGEST = 4096
"""Largest number of peaks of one density with which its entropy is computed by quadrature.

The cost grows with the square of this number: all pairs of peaks are compared, and the component at each peak is
evaluated at the nodes of all peaks.
"""
DRAWS = 1024
"""Number of draws for the entropy of a density that quadrature does not resolve."""
_log = logging.getLogger(__name__)

_HALF = (
    *(0.0, 0.20778495500789847, 0.40584515137739717, 0.5860872354676911),
    *(0.7415311855993945, 0.8648644233597691, 0.9491079123427585, 0.9914553711208126),
)
_WEIGHTS = (
    *(0.20948214108472782, 0.20443294007529889, 0.19035057806478542, 0.1690047266392679),
    *(0.14065325971552592, 0.10479001032225019, 0.06309209262997856, 0.022935322010529224),
)
# Kronrod's rule of 15 nodes and, at every second node, Gauss's rule of 7 (Piessens et al. 1983, QK15)
NODES = torch.tensor([*(-node for node in _HALF[:0:-1]), *_HALF], dtype=torch.float64)
FINE = torch.tensor([*_WEIGHTS[:0:-1], *_WEIGHTS], dtype=torch.float64)
COARSE = torch.zeros(15, dtype=torch.float64)
COARSE[1::2] = torch.from_numpy(np.polynomial.legendre.leggauss(7)[1])


class Panels(NamedTuple):
    """Panels: intervals over which densities are integrated, x = place + scale · sinh(v) with low ≤ v ≤ high.

    All fields have the shape (panel,). `item` is the index of the density, `place` is the position of a peak, and
    `scale` is the width of this peak.
    """

    item: Tensor
    place: Tensor
    scale: Tensor
    low: Tensor
    high: Tensor

    def of(self, chosen: Tensor) -> "Panels":
        """Return the panels that `chosen`, a mask or indices, selects."""
        return Panels(*(column[chosen] for column in self))

    def halves(self) -> "Panels":
        """Return the lower halves of all panels, then the upper halves."""
        middle = (self.low + self.high) / 2
        both = zip(self._replace(high=middle), self._replace(low=middle), strict=True)
        return Panels(*map(torch.cat, both))


def has_range(density: Distribution) -> bool:
    """Return true for a density of one number on a circle, a part of a circle, or the whole real line.

    `entropy_of_one` computes the entropy of such a density.
    """
    support = density.support
    real = isinstance(support, constraints.independent) and support.base_constraint is constraints.real
    return tuple(density.event_shape) == (1,) and (real or isinstance(support, Circular))


def entropy_of_one(density: Distribution) -> Float[Tensor, "*batch"]:
    """Return the entropy of a density of one number, nats, accurate to 1e-9 in float64 and to rounding in float32.

    The density is integrated over panels, which begin at its `mode_candidates` and are as wide there as its
    `peak_widths` suggest. A panel is halved until Kronrod's and Gauss's rule agree on it. The nodes are given relative
    to the peak, so that the rounding of the number itself does not limit how narrow a peak may be.

    If the integral of the density differs from 1 by more than 1e-7 (float32: 1e-4), some peak is missing from
    `mode_candidates`, or a tail is too long. In this case, and if there are more than LARGEST peaks, the entropy is the
    mean of -log_prob over DRAWS draws, and a warning is logged. If the density is NaN, its entropy is NaN. The entropy
    has a gradient in the parameters of the density.
    """
    items = density.batch_shape.numel()
    if items == 0:
        return density.log_prob(density.sample())
    flat = Reshaped(density, (items,))
    with torch.no_grad():
        places = mode_candidates(flat).squeeze(-1).double()
    if len(places) > LARGEST:
        _log.warning(
            "%d densities (%s) have more than %d peaks; their entropies are means over %d draws.",
            items, type(density).__name__, LARGEST, DRAWS,
        )  # fmt: skip
        return drawn_entropy(flat).reshape(density.batch_shape)
    with torch.no_grad():
        dtype = density.sample(torch.Size((0,))).dtype
        panels = first_panels(flat, places)
        step = max(1, AT_ONCE // (len(NODES) * len(places)))
        tolerance = TOLERANCE.get(dtype, 1e-6)
        accepted, sums = refine_panels(flat, panels, step, tolerance)
    if torch.is_grad_enabled():
        sums = torch.cat([integrate(flat, part)[0] for part in split(accepted, step)], -1)
    mass, entropy = torch.zeros(2, items, dtype=sums.dtype, device=sums.device).index_add(
        1, accepted.item, sums
    )
    # entropy of the density normalised on these nodes
    result = entropy / mass + mass.log()
    missed = ((mass - 1).abs() > MASS_GAP * tolerance).detach()
    if bool(missed.any()):
        _log.warning(
            "Quadrature does not find all the mass of %d of %d densities (%s); their entropies are means over "
            "%d draws.", int(missed.sum()), items, type(density).__name__, DRAWS,
        )  # fmt: skip
        result = torch.where(missed, drawn_entropy(flat).to(result), result)
    return result.reshape(density.batch_shape).to(dtype)


def drawn_entropy(density: Distribution) -> Float[Tensor, "*batch"]:
    """Return the entropy of a density as the mean of -log_prob over DRAWS draws, nats, with an unbiased gradient.

    The gradient of this mean at fixed draws has expectation 0. It is not the gradient of the entropy, since the
    distribution of the draws changes too. The gradient of -E log p is -E (log p - b) ∇ log p, for any constant b (score
    function, Mohamed et al. 2020, §4). Here b is the mean of log p over the draws; its estimation takes one degree of
    freedom from DRAWS.
    """
    log_prob = density.log_prob(density.sample(torch.Size((DRAWS,))))
    mean = log_prob.mean(0)
    if not log_prob.requires_grad:
        return -mean
    moves = ((log_prob - mean).detach() * log_prob).sum(0) / (DRAWS - 1)
    return moves.detach() - moves - mean.detach()


def split(panels: Panels, step: int) -> list[Panels]:
    """Return the panels in groups of at most `step` panels."""
    return [Panels(*part) for part in zip(*(column.split(step) for column in panels), strict=True)]


def integrate(density: Distribution, panels: Panels) -> tuple[Tensor, Tensor]:
    """Return ∫ p and -∫ p log p over each panel, (2, panel), and an error for each panel, (panel,).

    The integrals are computed by Kronrod's rule. The error is the larger of the two differences to Gauss's rule.
    """
    like = panels.place
    half = (panels.high - panels.low) / 2
    v = (panels.high + panels.low) / 2 + half * NODES.to(like).unsqueeze(-1)
    offset, slope = panels.scale * v.sinh(), half * panels.scale * v.cosh()
    log_prob = recentre(density, (panels.item,), like.unsqueeze(-1)).log_prob(offset.unsqueeze(-1)).to(like)
    mass = log_prob.exp() * slope
    # p log p → 0 as p → 0; the clamp keeps 0 · (-inf) from being NaN
    both = torch.stack([mass, -mass * log_prob.clamp(min=-1e4)], -1)
    fine, coarse = (torch.einsum("n,npk->kp", rule.to(like), both) for rule in (FINE, COARSE))
    return fine, (fine - coarse).detach().abs().amax(0)


def refine_panels(
    density: Distribution, panels: Panels, step: int, tolerance: float
) -> tuple[Panels, Tensor]:
    """Halve panels until Kronrod's and Gauss's rule agree on each of them.

    Args:
        density: the density of one number, with one batch dimension.
        panels: the first panels.
        step: largest number of panels that are evaluated at once.
        tolerance: largest difference of the two rules.

    Returns:
        The panels, and the integrals of `integrate` over them, (2, panel).
    """
    items = density.batch_shape.numel()
    finished: list[tuple[Panels, Tensor]] = []
    for number in range(ROUNDS + 1):
        parts = [integrate(density, part) for part in split(panels, step)]
        sums, error = (torch.cat(pair, -1) for pair in zip(*parts, strict=True))
        more = error > tolerance  # false for NaN, which halving would not remove
        crowded = torch.bincount(panels.item[more], minlength=items) > MOST
        more &= ~crowded[panels.item] & (number < ROUNDS)
        finished.append((panels.of(~more), sums[:, ~more]))
        if not bool(more.any()):
            break
        panels = panels.of(more).halves()
    accepted, sums = zip(*finished, strict=True)
    return Panels(*map(torch.cat, zip(*accepted, strict=True))), torch.cat(sums, -1)


def first_panels(density: Distribution, place: Float[Tensor, "peak item"]) -> Panels:
    """Return the panels before they are halved: on both sides of every peak, up to the middle between two peaks.

    Args:
        density: the density of one number.
        place: the density's `mode_candidates`.
    """
    scale = known_scales(density)  # (peak, item)
    support = density.support
    low, high = -math.inf, math.inf
    if isinstance(support, Circular):
        low, high = support.ranges[0] if support.ranges else (-math.pi, math.pi)
        place = torch.where((place < low) | (place > high), wrap(place), place).clamp(low, high)
    closed = isinstance(support, Circular) and support.ranges is None
    place = place.nan_to_num(nan=0.0).clamp(-1e300, 1e300)
    rows = max(1, AT_ONCE // len(place) ** 2)
    nearest = [
        torch.cat(
            [_smallest_scale_at(some, *part, closed) for some in part[0].split(max(1, AT_ONCE // len(place)))]
        )
        for part in zip(place.split(rows, 1), scale.split(rows, 1), strict=True)
    ]
    reach = REACH * scale.amax(0, keepdim=True)
    order = place.sort(0)
    place, scale = order.values, torch.cat(nearest, 1).gather(0, order.indices)
    place, scale = _representatives(place, scale)
    if closed:
        after = torch.cat([place[1:] - place[:-1], place[:1] - place[-1:] + 2 * math.pi]) / 2
        before = after.roll(1, 0)
    else:
        first, last = (reach, reach) if math.isinf(high) else (place[:1] - low, high - place[-1:])
        between = (place[1:] - place[:-1]) / 2
        before, after = torch.cat([first, between]), torch.cat([between, last])
    item = torch.arange(place.shape[1], device=place.device).expand(place.shape)
    sides = []
    for sign, length in ((-1, before), (1, after)):
        end = (length / scale).asinh()
        count = (end / WIDTH).ceil().to(torch.int64).flatten()
        columns = [column.flatten().repeat_interleave(count) for column in (item, place, scale, end / WIDTH)]
        number = torch.arange(len(columns[0]), device=place.device) - (
            count.cumsum(0) - count
        ).repeat_interleave(count)
        stop = torch.minimum(number + 1, columns[3]) * WIDTH
        ends = (number * WIDTH, stop) if sign > 0 else (-stop, -number * WIDTH)
        sides.append((*columns[:3], *ends))
    return Panels(*map(torch.cat, zip(*sides, strict=True)))


def known_scales(density: Distribution) -> Float[Tensor, "peak item"]:
    """Return the density's `peak_widths`, float64; 1 where a width is not a finite number above 0."""
    scale = peak_widths(density).double()
    return torch.where((scale > 0) & scale.isfinite(), scale, 1.0)


def _smallest_scale_at(some: Tensor, place: Tensor, scale: Tensor, closed: bool) -> Tensor:
    """Return for each position in `some` the smallest scale of all peaks near it, (some, item).

    A peak is near if it is at most 10 times its scale away.

    Args:
        some: positions, (some, item).
        place: positions of all peaks, (peak, item).
        scale: scales (widths) of all peaks, (peak, item).
        closed: true if the number is an angle that covers the whole circle.
    """
    distance = some.unsqueeze(1) - place  # (some, other, item)
    distance = (wrap(distance) if closed else distance).abs()
    return scale.expand_as(distance).where(distance <= 10 * scale, math.inf).amin(1)


def first_in_cell(
    place: Float[Tensor, "peak item"], scale: Float[Tensor, "peak item"], width: float
) -> Bool[Tensor, "peak item"]:
    """Divide the real line into cells, and return a mask of the peaks that are the first ones in their cells.

    The width of a cell is `width` times the largest power of two that is at most the scale of the peak. Two peaks with
    cells of different width are never in the same cell.

    Args:
        place: positions of the peaks, ascending.
        scale: scales (widths) of the peaks.
        width: largest width of a cell, in multiples of the scale of a peak.
    """
    cell = width * scale.log2().floor().exp2()
    key = (place / cell).floor()
    new = torch.ones_like(place, dtype=torch.bool)
    new[1:] = (key[1:] != key[:-1]) | (cell[1:] != cell[:-1])
    return new


def _representatives(place: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
    """Return positions and scales of ascending peaks, with each peak replaced by the first peak in its cell.

    A cell is at most four scales wide (`first_in_cell`).
    """
    new = first_in_cell(place, scale, 4.0)
    number = torch.arange(len(place), device=place.device).unsqueeze(-1)
    chosen = torch.where(new, number, 0).cummax(0).values
    return place.gather(0, chosen), scale.gather(0, chosen)
