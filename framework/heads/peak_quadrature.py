"""Quadrature over one angle for a batch of functions, each with one or two peaks of any width."""

from collections.abc import Callable
from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

GRID = 64
"""Number of equal cells into which the interval is divided for the search of peaks."""
PEAKS = 2
"""Largest number of peaks that get nodes of their own; if there are more peaks, only the highest ones get them."""
ROUNDS = 14
"""Number of rounds that refine a peak.

Each round makes a peak's bracket five times narrower, or moves it: 0.1 rad becomes 1e-8 in ten rounds.
"""
NEAR = 12.0
"""Length of the panel next to a peak, in widths of the peak; a second panel covers the rest of the interval."""
NODES = (32, 24)


@torch.no_grad()
def nodes(
    log_density: Callable[[Tensor], Tensor],
    low: float,
    high: float,
    like: Float[Tensor, "*batch"],
    periodic: bool = False,
) -> tuple[Float[Tensor, "*batch node"], Float[Tensor, "*batch node"]]:
    """Return nodes, radians, and weights of a quadrature over [low, high] that resolves exp(log_density).

    If log_density has more than two maxima, only the two highest have nodes of their own.

    Args:
        log_density: maps points (*batch, point) to values (*batch, point), nats up to a constant per batch element.
        low: lower end, radians.
        high: upper end, radians.
        like: a tensor with the batch shape and the device of the result.
        periodic: whether `high` is the same angle as `low`; the interval then starts where log_density is smallest.
    """
    step = (high - low) / GRID
    grid = torch.linspace(low, high, GRID + 1, dtype=torch.float64, device=like.device)
    grid = grid.expand(*like.shape, GRID + 1)
    value = log_density(grid)
    if periodic:
        cut = value[..., :-1].argmin(-1, keepdim=True)
        grid = grid + step * cut
        value = value[..., :-1].gather(-1, (cut + torch.arange(GRID + 1, device=like.device)) % GRID)
    ends = grid[..., :1], grid[..., -1:]
    before = torch.nn.functional.pad(value[..., :-1], (1, 0), value=-torch.inf)
    after = torch.nn.functional.pad(value[..., 1:], (0, 1), value=-torch.inf)
    summits = value.where((value > before) & (value >= after), -torch.inf)
    heights, index = summits.topk(PEAKS)
    absent = heights == -torch.inf
    # a peak that does not exist is placed at the upper end, where its piece of the interval is empty
    index, order = index.where(~absent, GRID).sort(-1)
    absent = absent.gather(-1, order)
    summit = grid.gather(-1, index)
    peak, width = refine(
        log_density, summit, step, (summit - step).maximum(ends[0]), (summit + step).minimum(ends[1])
    )
    peak = peak.where(~absent, ends[1])
    # the border between the pieces of two peaks is where the function is smallest
    inside = torch.arange(GRID + 1, device=like.device)
    borders = [ends[0]]
    for number in range(PEAKS - 1):
        between = (inside >= index[..., number, None]) & (inside <= index[..., number + 1, None])
        valley = grid.gather(-1, value.where(between, torch.inf).argmin(-1, keepdim=True))
        valley = valley.where(~absent[..., number + 1, None], ends[1])
        borders.append(
            torch.maximum(torch.minimum(valley, peak[..., number + 1, None]), peak[..., number, None])
        )
    borders.append(ends[1])
    points, weights = [], []
    for number in range(PEAKS):
        centre, spread = peak[..., number, None], width[..., number, None]
        for sign, length in ((-1, centre - borders[number]), (1, borders[number + 1] - centre)):
            offset, weight = _half(length.clamp(min=0), spread)
            points.append(centre + sign * offset)
            weights.append(weight)
    return torch.cat(points, -1), torch.cat(weights, -1)


@cache
def equal(count: int, low: float, high: float) -> tuple[Float[Tensor, "node"], Float[Tensor, "node"]]:
    """Return `count` nodes and the weights of the trapezium rule over the period from `low` to `high`."""
    step = (high - low) / count
    return low + step * torch.arange(count, dtype=torch.float64), torch.full(
        (count,), step, dtype=torch.float64
    )


@cache
def gauss(count: int, low: float, high: float) -> tuple[Float[Tensor, "node"], Float[Tensor, "node"]]:
    """Return `count` nodes and the weights of Gauss-Legendre quadrature over [low, high]."""
    at, weights = np.polynomial.legendre.leggauss(count)
    half = (high - low) / 2
    return torch.from_numpy(low + half * (at + 1)), torch.from_numpy(half * weights)


def maximum(
    log_density: Callable[[Tensor], Tensor], starts: Float[Tensor, "*batch start"], step: float
) -> Float[Tensor, "*batch"]:
    """Return the position, radians, of the highest maximum of `log_density` within the distance `step` of a start."""
    peaks, _ = refine(log_density, starts, step, starts - step, starts + step)
    best = log_density(peaks).argmax(-1, keepdim=True)
    return peaks.gather(-1, best).squeeze(-1)


def refine(
    log_density: Callable[[Tensor], Tensor],
    centre: Float[Tensor, "*batch start"],
    reach: float | Tensor,
    low: Tensor,
    high: Tensor,
) -> tuple[Float[Tensor, "*batch start"], Float[Tensor, "*batch start"]]:
    """Return the peak in [low, high] near each start `centre`, and its width, radians.

    The width is the distance from the peak at which the log-density has fallen by about 1. A peak is found by parabolas
    through three points, which are `reach` apart at first and come closer with each round.
    """
    width, step = torch.full_like(centre, torch.inf), torch.zeros_like(centre) + reach
    for _ in range(ROUNDS):
        three = log_density(torch.cat([centre - step, centre, centre + step], -1))
        left, middle, right = three.split(centre.shape[-1], -1)
        slope, bend = (right - left) / 2, 2 * middle - left - right
        inside = bend > slope.abs()
        move = torch.where(inside, slope / bend.where(inside, 1), slope.sign())
        fall = torch.maximum(bend.clamp(min=0).sqrt(), slope.abs())
        width = torch.where(fall > 0.3, step / fall, width)
        centre = torch.maximum(torch.minimum(centre + step * move, high), low)
        # if the maximum of the parabola lies outside the three points, the step is not reduced
        step = torch.where(inside | (centre == high) | (centre == low), step / 5, step)
    return centre, width.clamp(max=1.0)


def _half(length: Tensor, width: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distances of nodes on one side of a peak, in [0, length], and their weights.

    The quadrature is Gauss-Legendre quadrature in y; the distance of a node is width · sinh y.
    """
    ends = [
        torch.asinh(torch.minimum(length / width, torch.full_like(length, NEAR))),
        torch.asinh(length / width),
    ]
    offsets, weights, start = [], [], torch.zeros_like(length)
    for count, end in zip(NODES, ends, strict=True):
        at, weight = (part.to(length.device) for part in gauss(count, 0.0, 1.0))
        y = start + (end - start) * at
        offsets.append(width * torch.sinh(y))
        weights.append((end - start) * weight * width * torch.cosh(y))
        start = end
    return torch.cat(offsets, -1), torch.cat(weights, -1)
