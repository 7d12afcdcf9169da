"""The surface between projected points, computed from the points alone, as input of a network that refines the image.

Splats follow the idea of Zwicker, Pfister, van Baar & Gross, "EWA Splatting", IEEE TVCG 8(3), 2002, in image space: a
pixel shows a weighted mean of the points around the pixel that no nearer surface hides.
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
"""Thickness of a surface, in widths of a pixel: points up to this distance behind the surface belong to it."""
LEAST_WIDTH, SHARE = 0.45, 0.6
"""Terms of a splat's standard deviation, pixels: a constant, and a share of the distance to the nearest point."""


@cache
def disc(radius: int) -> np.ndarray:
    """Return (row, column) of the offsets from a pixel to the pixels of a disc around it, row by row, (offsets, 2)."""
    side = np.arange(-radius, radius + 1)
    rows, columns = np.meshgrid(side, side, indexing="ij")
    within = rows**2 + columns**2 <= radius * (radius + 1)
    return np.stack([rows[within], columns[within]], 1)


@cache
def weights(radius: int) -> np.ndarray:
    """Return a table of the weights of points in the mean that a pixel shows.

    Entry (i, j) is the weight of a point at the squared distance i from the pixel, if the point whose cone is nearest
    in this pixel (`compute_surface`) is at the squared distance j. Distances are in pixels; i and j are 0 to radius ·
    (radius + 1).
    """
    square = np.arange(radius * (radius + 1) + 1)
    width = LEAST_WIDTH + SHARE * np.sqrt(square)
    return np.exp(-square[:, None] / (2 * width**2))


def closing_radius(radius: int) -> int:
    """Return the radius, pixels, of the morphological closing for splats of radius `radius`.

    The closing fills gaps that are up to twice as wide as the returned radius.
    """
    return (3 * radius + 2) // 5


def compute_surface(
    images: Float[Tensor, "batch 4 height width"], limits: tuple[float, float], focal: float, radius: int
) -> Float[Tensor, "batch 5 height width"]:
    """Return images of the surface through the points that the images of `encoder.project` show.

    Each point has a cone of radius `radius` around itself, which hides the points behind the cone. With each pixel
    of distance from the point, the depth of the cone grows by the width of a pixel. In each pixel, the nearest cone
    gives the depth of the surface and the distance, in pixels, to the cone's point. The fifth channel is this
    distance as a share of radius + 1, or 1 if no point is within `radius`. The first four channels are the mean of
    the points of the surface within `radius`, weighted by a Gaussian that is wider the more pixels the cone's point
    is away. In pixels that do not belong to the subject these four channels are 1. The pixels of the subject are
    those that show a point, with the gaps between them filled by a morphological closing.

    On the CPU the function is compiled unless a gradient is required. All implementations give the same bits. The
    result is differentiable in the channels of the images, but not in the set of visible points.

    Args:
        images: images of `encoder.project` at one level, (batch, 4, height, width).
        limits: nearest and farthest depth, metres, at which the fourth channel is 0 and 1.
        focal: focal length, pixels.
        radius: radius of a splat, pixels, at least 1.
    """
    if images.device.type != "cpu" or (images.requires_grad and torch.is_grad_enabled()):
        return compute_surface_in_torch(images, limits, focal, radius)
    surfaces = images.new_empty(len(images), CHANNELS, *images.shape[2:])
    arrays, filled = images.detach().contiguous().numpy(), surfaces.numpy()
    nearest, farthest = limits

    def draw(number: int) -> None:
        compiled.splat(
            arrays[number],
            nearest,
            farthest - nearest,
            focal,
            THICK,
            disc(radius),
            disc(closing_radius(radius)),
            weights(radius),
            filled[number],
        )

    POOL.share(draw, len(arrays), torch.get_num_threads())
    return surfaces


def compute_surface_in_torch(
    images: Tensor, limits: tuple[float, float], focal: float, radius: int
) -> Tensor:
    """Return the result of `compute_surface` by operations on tensors, on any device."""
    nearest, farthest = limits
    height, width = images.shape[2:]
    shown = images[:, 3] < 1
    numbers = images.double()
    depth = (nearest + (farthest - nearest) * numbers[:, 3]).detach().where(shown, torch.inf)

    def shift(maps: Tensor, offset: np.ndarray, beyond: float) -> Tensor:
        """Return maps in which each pixel has the value of the pixel at `offset` from it, or `beyond` outside."""
        row, column = (int(component) + radius for component in offset)
        wide = functional.pad(maps, (radius,) * 4, value=beyond)
        return wide[..., row : row + height, column : column + width]

    first = torch.full_like(depth, torch.inf)
    square = torch.full_like(depth, radius * (radius + 1) + 1)
    for offset in disc(radius):
        squared_distance = int((offset**2).sum())
        cone = shift(depth, offset, torch.inf) * (1 + squared_distance**0.5 / focal)
        ahead = (cone < first) | ((cone == first) & (squared_distance < square))
        first, square = cone.where(ahead, first), square.where(~ahead, squared_distance)
    reached = first < torch.inf
    behind = first * (1 + THICK / focal)
    table = torch.from_numpy(weights(radius)).to(depth.device)
    own = square.long().clamp(max=radius * (radius + 1))
    total, mass = torch.zeros_like(numbers), torch.zeros_like(depth)
    for offset in disc(radius):
        weight = table[int((offset**2).sum())][own].where(shift(depth, offset, torch.inf) < behind, 0.0)
        total = total + weight[:, None] * shift(numbers, offset, 0.0)
        mass = mass + weight
    near = torch.zeros_like(shown)
    for offset in disc(closing_radius(radius)):
        near = near | (shift(shown.double(), offset, 0.0) > 0)
    inside = near
    for offset in disc(closing_radius(radius)):
        inside = inside & (shift(near.double(), offset, 1.0) > 0)
    surface = (total / mass.where(inside, 1.0)[:, None]).where(inside[:, None], 1.0)
    # not `square.sqrt()`, because torch calls MKL's square root, whose last bit is wrong on some processors
    roots = torch.from_numpy(np.sqrt(np.arange(radius * (radius + 1) + 2))).to(depth.device)
    distance = (roots[square.long()] / (radius + 1)).where(reached, 1.0)
    return torch.cat([surface, distance[:, None]], 1).to(images.dtype)
