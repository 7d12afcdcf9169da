"""The surface between projected points, computed from the points alone, for networks of neural pixels to refine.

Splats follow the idea of Zwicker, Pfister, van Baar & Gross, "EWA Splatting", IEEE TVCG 8(3), 2002, in pixels: a pixel
shows a weighted mean of the points around it that no nearer surface hides.
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
"""Number of channels: red, green, blue and depth of the surface, and the distance to the nearest point."""
THICK = 4.0
"""Thickness of a surface, in widths of a pixel: points up to this far behind the nearest surface belong to it."""
LEAST_WIDTH, SHARE = 0.45, 0.6
"""Terms of a splat's standard deviation, pixels: a constant, and a share of the distance to the nearest point."""


@cache
def disc(radius: int) -> np.ndarray:
    """Return (row, column) of the offsets around a pixel that lie in a disc, row by row, (places, 2)."""
    side = np.arange(-radius, radius + 1)
    rows, columns = np.meshgrid(side, side, indexing="ij")
    within = rows**2 + columns**2 <= radius * (radius + 1)
    return np.stack([rows[within], columns[within]], 1)


@cache
def weights(radius: int) -> np.ndarray:
    """Return a point's weight, indexed by its squared distance and that of the nearest point, in squared pixels."""
    square = np.arange(radius * (radius + 1) + 1)
    width = LEAST_WIDTH + SHARE * np.sqrt(square)
    return np.exp(-square[:, None] / (2 * width**2))


def closing(radius: int) -> int:
    """Return the radius, pixels, of the closing of holes; it closes gaps up to twice this radius."""
    return (3 * radius + 2) // 5


def splatted(
    pictures: Float[Tensor, "batch 4 height width"], limits: tuple[float, float], focal: float, radius: int
) -> Float[Tensor, "batch 5 height width"]:
    """Return the surface through the points that the images of `encoder.project` show.

    A cone around each point hides what is behind it. Its depth grows by the width of a pixel with each pixel. The first
    cone that a pixel meets gives the depth of the surface, and the distance to the nearest of its points. The fifth
    channel is this distance as a share of radius + 1; it is 1 where no point is within `radius`. The pixel shows the
    mean of the points of that surface within `radius`. The mean is weighted by a Gaussian, which is wider where the
    nearest point is farther away. All channels are 1 outside the outline. The outline is that of the points with holes
    closed (a morphological closing).

    The function is compiled on the CPU if no gradient is wanted; all ways give the same bits. It is differentiable in
    the channels, not in which points are seen.

    Args:
        pictures: images of `encoder.project` at one level, (batch, 4, height, width).
        limits: nearest and farthest depth, metres, at which the fourth channel is 0 and 1.
        focal: pixels.
        radius: pixels, 1 or more.
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
    """Return the result of `splatted` by operations on tensors, on any device."""
    nearest, farthest = limits
    height, width = pictures.shape[2:]
    seen = pictures[:, 3] < 1
    numbers = pictures.double()
    depth = (nearest + (farthest - nearest) * numbers[:, 3]).detach().where(seen, torch.inf)

    def moved(maps: Tensor, place: np.ndarray, beyond: float) -> Tensor:
        """Return the maps shifted so that each pixel holds the value at the offset `place` from it."""
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
    # not `square.sqrt()`: torch calls MKL's square root, which errs in the last bit on some processors
    roots = torch.from_numpy(np.sqrt(np.arange(radius * (radius + 1) + 2))).to(depth.device)
    distance = (roots[square.long()] / (radius + 1)).where(reached, 1.0)
    return torch.cat([surface, distance[:, None]], 1).to(pictures.dtype)
