"""Textures on faces: texels around a place, and the interpolated colour; compiled functions on arrays.

Texel centres lie at whole numbers: u W - 1/2 from the left and (1 - v) H - 1/2 from the top.
"""

from typing import NamedTuple, no_type_check

import numpy as np

from plugins.renderer.rasterizer.raster import compiled

REPEAT, CLAMP, MIRROR = range(3)
WRAPS = {"repeat": REPEAT, "clamp": CLAMP, "mirror": MIRROR}
FARTHEST_UV = 1e6
"""Largest uv for which float32 still resolves a place within an image."""


class Laid(NamedTuple):
    """A texture in the form that kernels read.

    Attributes:
        texels: (texels, channels), the texels of all images one after the other, each image row by row from the top.
        images: (images, 3) int64, the first texel, height and width of each image.
        uv: (places, 2).
        corners: (faces, 3) int32, rows of `uv`.
        shown: (faces) int32, the image of each face, or -1.
        wrap: `REPEAT`, `CLAMP` or `MIRROR`.
        smooth: whether to interpolate between texels.
    """

    texels: np.ndarray
    images: np.ndarray
    uv: np.ndarray
    corners: np.ndarray
    shown: np.ndarray
    wrap: int
    smooth: bool


@compiled
@no_type_check
def uv_at(laid, index, w0, w1, w2):
    """Return the place in its texture that a face shows at barycentric weights."""
    a, b, c = laid.corners[index, 0], laid.corners[index, 1], laid.corners[index, 2]
    uv = laid.uv
    return (
        w0 * uv[a, 0] + w1 * uv[b, 0] + w2 * uv[c, 0],
        w0 * uv[a, 1] + w1 * uv[b, 1] + w2 * uv[c, 1],
    )


@compiled
@no_type_check
def wrapped(place, count, wrap):
    """Return the texel of a row of `count` texels that stands at an integer place, also beyond the row's ends."""
    if wrap == CLAMP:
        return min(max(place, 0), count - 1)
    if wrap == REPEAT:
        return place % count
    place %= 2 * count
    return min(place, 2 * count - 1 - place)


@compiled
@no_type_check
def among_texels(laid, image, u, v):
    """Return the four texels around a place, and its distance to the right and down between them, 0 to 1.

    The texels start at the top left and run row by row. In a texture that is not smooth, all four are the same texel.
    """
    start, height, width = laid.images[image, 0], laid.images[image, 1], laid.images[image, 2]
    x, y = u * width - 0.5, (1 - v) * height - 0.5
    if not laid.smooth:
        x, y = np.floor(x + 0.5), np.floor(y + 0.5)
    left, top = np.floor(x), np.floor(y)
    right, down = x - left, y - top
    first_column = wrapped(np.int64(left), width, laid.wrap)
    first_row = start + wrapped(np.int64(top), height, laid.wrap) * width
    if not laid.smooth:
        texel = first_row + first_column
        return texel, texel, texel, texel, 0.0, 0.0
    last_column = wrapped(np.int64(left) + 1, width, laid.wrap)
    last_row = start + wrapped(np.int64(top) + 1, height, laid.wrap) * width
    return (
        first_row + first_column,
        first_row + last_column,
        last_row + first_column,
        last_row + last_column,
        right,
        down,
    )


@compiled
@no_type_check
def mixed(laid, place, channel):
    """Return the colour of a texture at a place from `among_texels`."""
    a, b, c, d, right, down = place
    texels = laid.texels
    above = texels[a, channel] + right * (texels[b, channel] - texels[a, channel])
    below = texels[c, channel] + right * (texels[d, channel] - texels[c, channel])
    return above + down * (below - above)


@compiled
@no_type_check
def mixed_slopes(laid, image, place, channel):
    """Return the derivatives of `mixed` in u and v."""
    a, b, c, d, right, down = place
    texels = laid.texels
    above = texels[b, channel] - texels[a, channel]
    below = texels[d, channel] - texels[c, channel]
    before = texels[c, channel] - texels[a, channel]
    after = texels[d, channel] - texels[b, channel]
    return (
        laid.images[image, 2] * (above + down * (below - above)),
        -laid.images[image, 1] * (before + right * (after - before)),
    )
