"""Adaptive quadrature of densities of three angles: a box is split where two quadrature rules disagree."""

import math
from functools import lru_cache

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular, wrap
from framework.testing.adaptive import gather_boxes, roughness, rule

RULES = (8, 5)
"""Gauss-Legendre points per side of a box in each of the two rules."""
TOLERANCE = 1e-6
"""Sum of the differences of the two integrals over all boxes at which no more boxes are split.

The integral by the finer rule is more accurate than this sum.
"""
MOST = 256
"""Largest number of boxes of one density that are split in one round."""
MOST_BOXES = 1500
"""Number of boxes of one density beyond which no more boxes are split; densities that jump reach it."""
MOST_NODES = 2**19
"""Largest number of nodes, times rows, at which the density is evaluated at once."""


@lru_cache(maxsize=4)
def cells_of_three_angles(density: Distribution, count: int) -> tuple[list[Tensor], Tensor]:
    """Return the borders of equal cells along each angle, (count + 1,), and their masses (*cells, *batch), float64.

    The cells are the first boxes. A box that contains the mode is split at the mode, so that a density with a kink or a
    sharp tip there is smooth in every box. Then the boxes in which the two rules differ most are split, until the
    differences of all boxes sum up to less than TOLERANCE. A box is split across the axis along which the density is
    roughest.

    Args:
        density: Density of three angles, each over a whole turn or over a shorter range.
        count: Cells per angle.
    """
    assert isinstance(density.support, Circular)
    batch, rows = density.batch_shape, density.batch_shape.numel()
    ends = density.support.ranges or ((-math.pi, math.pi),) * 3
    borders = [torch.linspace(low, high, count + 1, dtype=torch.float64) for low, high in ends]
    mode = wrap(density.mode.double()).nan_to_num().reshape(rows, 3)
    edges = [
        torch.cat([border[:, None].expand(-1, rows), mode[:, axis].clamp(border[0], border[-1])[None]])
        .sort(0)
        .values
        for axis, border in enumerate(borders)
    ]
    index = torch.cartesian_prod(*[torch.arange(count + 1)] * 3)
    low = torch.stack([edge[index[:, axis]] for axis, edge in enumerate(edges)], -1)
    high = torch.stack([edge[index[:, axis] + 1] for axis, edge in enumerate(edges)], -1)
    parts = _evaluate_boxes(density, low, high)
    while len(parts[0]) < MOST_BOXES:
        difference, order = parts[3].sort(0, descending=True)
        # the boxes to split are those without which the differences sum up to less than half of the tolerance
        rest = difference.flip(0).cumsum(0).flip(0)
        done = rest[0] < TOLERANCE
        if done.all():
            break
        split = min(int(torch.where(done, 0, rest > TOLERANCE / 2).sum(0).max()), MOST)
        low, high, rough = (gather_boxes(parts[part], order[:split]) for part in (0, 1, 4))
        across = torch.nn.functional.one_hot(rough.argmax(-1), 3).bool()
        middle = torch.where(across, (low + high) / 2, math.nan)
        halves = torch.cat([low, middle.fmax(low)]), torch.cat([middle.fmin(high), high])
        fresh = _evaluate_boxes(density, *halves)
        parts = tuple(
            torch.cat([gather_boxes(old, order[split:]), new]) for old, new in zip(parts, fresh, strict=True)
        )
    low, high, box_mass = parts[:3]
    # boxes never extend beyond a cell, so the middle of a box tells the cell
    cell = torch.zeros_like(low[..., 0], dtype=torch.int64)
    for axis, border in enumerate(borders):
        middle = ((low + high) / 2)[..., axis].contiguous()
        cell = cell * count + torch.bucketize(middle, border[1:-1])
    mass = torch.zeros(count**3, rows, dtype=torch.float64).scatter_add_(0, cell, box_mass)
    return borders, mass.reshape(*[count] * 3, *batch)


def _evaluate_boxes(density: Distribution, low: Tensor, high: Tensor) -> tuple[Tensor, ...]:
    """Return the corners of boxes, their masses, the differences of the two rules, and the roughness along each axis.

    Corners and roughness have shape (box, rows, 3), masses and differences (box, rows).
    """
    dtype = density.sample(torch.Size((0,))).dtype  # an empty sample has the dtype of the density
    volume = (high - low).prod(-1)
    masses, rough = [], torch.zeros_like(low)
    for points in RULES:
        node, weight = rule(points, 3)
        value = low.unsqueeze(1) + (high - low).unsqueeze(1) * node[:, None]  # (box, node, rows, 3)
        flat = value.reshape(-1, *density.batch_shape, 3).to(dtype)
        log_prob = torch.cat(
            [density.log_prob(part) for part in flat.split(max(1, MOST_NODES // max(1, low.shape[1])))]
        )
        integrand = log_prob.double().reshape(value.shape[:-1]).exp() * volume.unsqueeze(1)
        masses.append((weight[:, None] * integrand).sum(1))
        if points == RULES[0]:
            rough = roughness(integrand.nan_to_num(), points, 3)
    return low, high, masses[0], (masses[0] - masses[1]).abs().nan_to_num(), rough
