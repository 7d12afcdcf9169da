"""Textures on faces: texels around a point of a texture, and interpolation between them; compiled functions.

In texel coordinates, u W - 1/2 from the left and (1 - v) H - 1/2 from the top, texel centres lie at whole numbers.
"""

from typing import NamedTuple, no_type_check

import numpy as np

from plugins.renderer.rasterizer.raster import compiled

REPEAT, CLAMP, MIRROR = range(3)
WRAPS = {"repeat": REPEAT, "clamp": CLAMP, "mirror": MIRROR}
FARTHEST_UV = 1e6
"""Largest uv for which float32 still resolves positions within an image."""


class TextureArrays(NamedTuple):
    """A texture in the form that kernels read.

    Attributes:
        texels: (texels, channels), the texels of all images in sequence, each image row by row from the top.
        images: (images, 3) int64, index of the first texel, height and width of each image.
        uv: (coordinates, 2), texture coordinates.
        corners: (faces, 3) int32, indices of `uv`.
        shown: (faces) int32, index of the image on each face, -1 for none.
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
def interpolate_uv(texture, index, w0, w1, w2):
    """Return the texture coordinates (u, v) of face `index` at the barycentric weights w0, w1, w2."""
    a, b, c = texture.corners[index, 0], texture.corners[index, 1], texture.corners[index, 2]
    uv = texture.uv
    return (
        w0 * uv[a, 0] + w1 * uv[b, 0] + w2 * uv[c, 0],
        w0 * uv[a, 1] + w1 * uv[b, 1] + w2 * uv[c, 1],
    )


@compiled
@no_type_check
def wrap_index(index, count, wrap):
    """Return the index from 0 to `count` - 1 that the wrap rule gives for any integer index."""
    if wrap == CLAMP:
        return min(max(index, 0), count - 1)
    if wrap == REPEAT:
        return index % count
    index %= 2 * count
    return min(index, 2 * count - 1 - index)


@compiled
@no_type_check
def find_texels(texture, image, u, v):
    """Return the indices of the four texels around (u, v), and the position of (u, v) between them.

    The texels are ordered from the top left, row by row. The position consists of the distances to the right and down
    from the first texel, each 0 to 1. If the texture is not smooth, all four are the same texel.
    """
    start, height, width = texture.images[image, 0], texture.images[image, 1], texture.images[image, 2]
    x, y = u * width - 0.5, (1 - v) * height - 0.5
    if not texture.smooth:
        x, y = np.floor(x + 0.5), np.floor(y + 0.5)
    left, top = np.floor(x), np.floor(y)
    right, down = x - left, y - top
    first_column = wrap_index(np.int64(left), width, texture.wrap)
    first_row = start + wrap_index(np.int64(top), height, texture.wrap) * width
    if not texture.smooth:
        texel = first_row + first_column
        return texel, texel, texel, texel, 0.0, 0.0
    last_column = wrap_index(np.int64(left) + 1, width, texture.wrap)
    last_row = start + wrap_index(np.int64(top) + 1, height, texture.wrap) * width
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
def interpolate(texture, texels_around, channel):
    """Return one colour channel, interpolated between the texels from `find_texels`."""
    a, b, c, d, right, down = texels_around
    texels = texture.texels
    above = texels[a, channel] + right * (texels[b, channel] - texels[a, channel])
    below = texels[c, channel] + right * (texels[d, channel] - texels[c, channel])
    return above + down * (below - above)


@compiled
@no_type_check
def interpolation_derivatives(texture, image, texels_around, channel):
    """Return the derivatives of `interpolate` with respect to u and v; `image` is the index of the texture's image."""
    a, b, c, d, right, down = texels_around
    texels = texture.texels
    above = texels[b, channel] - texels[a, channel]
    below = texels[d, channel] - texels[c, channel]
    before = texels[c, channel] - texels[a, channel]
    after = texels[d, channel] - texels[b, channel]
    return (
        texture.images[image, 2] * (above + down * (below - above)),
        -texture.images[image, 1] * (before + right * (after - before)),
    )
