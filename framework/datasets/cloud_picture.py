"""A small image of a point cloud."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from framework.geometry.mesh_files import COLOURS

AZIMUTH, ELEVATION = math.radians(-55), math.radians(25)
"""Direction of the camera, radians; in the image, x points to the front right, y to the back right, and z up."""
SPREAD = 0.8
"""Radius of a point's disc, divided by side / √(number of points), the spacing of points that fill the image evenly."""
NEAR, FAR = np.array([20.0, 40.0, 90.0]), np.array([190.0, 205.0, 225.0])
"""Colours of the nearest and the farthest point, RGB in 0…255."""


def draw_cloud(
    cloud: Float[Tensor, "points columns"], columns: Sequence[str] = (), side: int = 160
) -> UInt8[np.ndarray, "side side 3"]:
    """Draw a point cloud in orthographic projection from obliquely above, z up, on white.

    Nearer points hide farther ones. If `columns`, the names of the cloud's columns, includes the colours, points have
    their own colours, darkened with the distance; otherwise nearer points are darker. Rows that are not finite
    (padding) are left out. The image has `side` × `side` pixels.
    """
    table = cloud.detach().cpu().double().numpy()
    table = table[np.isfinite(table[:, :3]).all(1)]
    image = np.full((side * side, 3), 255, np.uint8)
    if not len(table):
        return image.reshape(side, side, 3)
    low, high = table[:, :3].min(0), table[:, :3].max(0)
    points = table[:, :3] - (low / 2 + high / 2)
    points /= max(np.abs(points).max(), np.finfo(np.float64).tiny)
    cos_a, sin_a, cos_e, sin_e = (f(x) for x in (AZIMUTH, ELEVATION) for f in (math.cos, math.sin))
    right = points @ [-sin_a, cos_a, 0.0]
    up = points @ [-sin_e * cos_a, -sin_e * sin_a, cos_e]
    depth = points @ [cos_e * cos_a, cos_e * sin_a, sin_e]  # towards the viewer
    extent = max(np.abs(right).max(), np.abs(up).max(), 1e-9)
    scale = (side / 2 - side / 40 - 1) / extent
    row = np.rint(side / 2 - up * scale).astype(np.int64)
    column = np.rint(side / 2 + right * scale).astype(np.int64)
    depth_range = np.ptp(depth)
    share = ((depth - depth.min()) / depth_range if depth_range > 0 else np.ones_like(depth))[:, None]
    if set(COLOURS) <= set(columns):
        own_colours = table[:, [list(columns).index(name) for name in COLOURS]].clip(0, 1)
        colour = 255 * own_colours * (0.6 + 0.4 * share)
    else:
        colour = FAR + (NEAR - FAR) * share
    # Each point covers a disc so large that the sides of a box look closed. The nearest point wins a pixel.
    radius = min(max(SPREAD * side / math.sqrt(len(points)), 1.0), side / 40)
    offsets = np.arange(-math.floor(radius), math.floor(radius) + 1)
    steps = np.stack(np.meshgrid(offsets, offsets), -1).reshape(-1, 2)
    steps = steps[(steps**2).sum(1) <= radius**2]
    pixel = ((row + steps[:, :1]) * side + column + steps[:, 1:]).clip(0, side * side - 1)
    nearest = np.full(side * side, -np.inf)
    np.maximum.at(nearest, pixel, np.broadcast_to(depth, pixel.shape))
    first, point = np.nonzero(depth == nearest[pixel])
    image[pixel[first, point]] = colour.round().astype(np.uint8)[point]
    return image.reshape(side, side, 3)
