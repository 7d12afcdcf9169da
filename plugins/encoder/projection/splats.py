"""The surface between projected points, from the points alone: the picture that a network of neural pixels adds to.

Splats in the spirit of Zwicker, Pfister, van Baar & Gross, "EWA Splatting", IEEE TVCG 8(3), 2002, in pixels: what a
pixel shows is a weighted mean of the points about it that no nearer surface hides.
"""

from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from framework.storage.threads import POOL
from plugins.encoder.projection import compiled

CHANNELS = 5
"""Red, green, blue and depth of the surface, and how far the nearest point is."""
THICK = 4.0
"""Points so many pixels' widths behind the nearest surface belong to it."""
LEAST_WIDTH, SHARE = 0.45, 0.6
"""A splat's standard deviation, pixels: so much, and so much of the distance to the nearest point."""


@cache
def disc(radius: int) -> np.ndarray:
    """(row, column) of the places about a pixel's, row by row."""
    side = np.arange(-radius, radius + 1)
    rows, columns = np.meshgrid(side, side, indexing="ij")
    within = rows**2 + columns**2 <= radius * (radius + 1)
    return np.stack([rows[within], columns[within]], 1)


@cache
def weights(radius: int) -> np.ndarray:
    """Of a point by its squared distance and that of the nearest one, pixels."""
    square = np.arange(radius * (radius + 1) + 1)
    width = LEAST_WIDTH + SHARE * np.sqrt(square)
    return np.exp(-square[:, None] / (2 * width**2))


def closing(radius: int) -> int:
    """Of holes that are closed: gaps up to twice this, pixels."""
    return (3 * radius + 2) // 5


def splatted(
    pictures: Float[Tensor, "batch 4 height width"], limits: tuple[float, float], focal: float, radius: int
) -> Float[Tensor, "batch 5 height width"]:
    """The surface through the points that pictures of `encoder.project` show.

    A cone about each point, whose depth grows by a pixel's width with each pixel, hides what is behind it; the first
    cone that a pixel meets says how near the surface is, and how far the nearest of its points, in shares of radius + 1
    (1: none is within `radius`). The pixel shows the mean of that surface's points within `radius`, weighted by a
    Gaussian that is the wider the farther the nearest is. All is 1 beyond the outline, which is that of the points
    with holes closed (a morphological closing).

    Args:
        limits: nearest and farthest depth, metres, which the fourth channel runs between.
        focal: pixels.
        radius: pixels, 1 or more.

    On the CPU compiled where no gradient is asked for; all ways give the same bits. Differentiable in the channels, not
    in which points are seen.
    """
    if pictures.device.type != "cpu" or (pictures.requires_grad and torch.is_grad_enabled()):
        return in_torch(pictures, limits, focal, radius)
    found = pictures.new_empty(len(pictures), CHANNELS, *pictures.shape[2:])
    given, filled = pictures.detach().contiguous().numpy(), found.numpy()
    nearest, farthest = limits

    def draw(number: int) -> None:
        compiled.splat(
            given[number],
            nearest,
            farthest - nearest,
            focal,
            THICK,
            disc(radius),
            disc(closing(radius)),
            weights(radius),
            filled[number],
        )

    POOL.share(draw, len(given), torch.get_num_threads())
    return found


def in_torch(pictures: Tensor, limits: tuple[float, float], focal: float, radius: int) -> Tensor:
    """The same by operations on tensors, on any device."""
    nearest, farthest = limits
    height, width = pictures.shape[2:]
    seen = pictures[:, 3] < 1
    numbers = pictures.double()
    depth = (nearest + (farthest - nearest) * numbers[:, 3]).detach().where(seen, torch.inf)

    def moved(maps: Tensor, place: np.ndarray, beyond: float) -> Tensor:
        """What lies `place` away from each pixel."""
        row, column = (int(each) + radius for each in place)
        wide = functional.pad(maps, (radius,) * 4, value=beyond)
        return wide[..., row : row + height, column : column + width]

    first = torch.full_like(depth, torch.inf)
    square = torch.full_like(depth, radius * (radius + 1) + 1)
    for place in disc(radius):
        away = int((place**2).sum())
        cone = moved(depth, place, torch.inf) * (1 + away**0.5 / focal)
        ahead = (cone < first) | ((cone == first) & (away < square))
        first, square = cone.where(ahead, first), square.where(~ahead, away)
    reached = first < torch.inf
    behind = first * (1 + THICK / focal)
    table = torch.from_numpy(weights(radius)).to(depth.device)
    own = square.long().clamp(max=radius * (radius + 1))
    total, mass = torch.zeros_like(numbers), torch.zeros_like(depth)
    for place in disc(radius):
        one = table[int((place**2).sum())][own].where(moved(depth, place, torch.inf) < behind, 0.0)
        total = total + one[:, None] * moved(numbers, place, 0.0)
        mass = mass + one
    near = torch.zeros_like(seen)
    for place in disc(closing(radius)):
        near = near | (moved(seen.double(), place, 0.0) > 0)
    inside = near
    for place in disc(closing(radius)):
        inside = inside & (moved(near.double(), place, 1.0) > 0)
    surface = (total / mass.where(inside, 1.0)[:, None]).where(inside[:, None], 1.0)
    # not `square.sqrt()`: MKL's, which torch calls, errs in the last bit on some processors
    roots = torch.from_numpy(np.sqrt(np.arange(radius * (radius + 1) + 2))).to(depth.device)
    distance = (roots[square.long()] / (radius + 1)).where(reached, 1.0)
    return torch.cat([surface, distance[:, None]], 1).to(pictures.dtype)
