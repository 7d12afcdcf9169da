"""Skin of generated people: painted by procedure, or an image in the body's own texture layout."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.random import Generator

from framework.datasets import images
from framework.errors import DataError
from framework.geometry.srgb import linear_from_bytes
from framework.storage.reading import read_bytes, translate_errors
from plugins.data.human_scans.anatomy import Anatomy
from plugins.data.human_scans.fabrics import Color, hue, noise

Carry = Callable[[np.ndarray], np.ndarray]


def files(folder: Path) -> list[Path]:
    """Return the paths of a folder's PNG images, sorted by name.

    Raises:
        DataError: the folder does not exist, or has no PNG.
    """
    images_found = sorted(folder.glob("*.png"))
    if not images_found:
        raise DataError(
            f"data.skins = {folder}: the folder holds no PNG file; expected images of skin in the texture layout of "
            "the default body. Set data.skins to such a folder, or to null."
        )
    return images_found


def content(file: Path) -> bytes:
    """Return the whole content of a skin's file.

    Raises:
        DataError: the file is missing, or is not a regular file.
    """
    with translate_errors(file, "an image of skin"):
        return read_bytes(file)


def read(file: Path) -> UInt8[np.ndarray, "height width 3"]:
    """Return a skin's pixels.

    Raises:
        DataError: the file is damaged.
    """
    with images.open_image(file) as image:
        return np.array(images.decode(image, 3, upright=False))


def colors_at(
    pixels: UInt8[np.ndarray, "height width 3"], uv: Float[np.ndarray, "places 2"]
) -> Float[np.ndarray, "places 3"]:
    """Return the linear RGB of a skin at texture coordinates, v upwards, interpolated between texels."""
    light = linear_from_bytes(torch.from_numpy(pixels)).numpy()
    height, width = light.shape[:2]
    x = (uv[:, 0] * width - 0.5).clip(0, width - 1.001)
    y = ((1 - uv[:, 1]) * height - 0.5).clip(0, height - 1.001)
    column, row = x.astype(np.int64), y.astype(np.int64)
    right, down = (x - column)[:, None], (y - row)[:, None]
    below, beside = np.minimum(row + 1, height - 1), np.minimum(column + 1, width - 1)
    top = light[row, column] * (1 - right) + light[row, beside] * right
    bottom = light[below, column] * (1 - right) + light[below, beside] * right
    return top * (1 - down) + bottom * down


BLANK = 128
"""Red, green and blue of unpainted texels, which garments are expected to cover."""


def fill_blanks(
    colors: Float[np.ndarray, "vertices 3"], body: Anatomy, count: int, average: Carry, carried: Carry
) -> Float[np.ndarray, "vertices 3"]:
    """Return the linear RGB of a skin at all vertices of the sheet, with colours for vertices that the skin left blank.

    Blank vertices get the median colour of the face, blended into their surroundings.

    Args:
        colors: linear RGB of all vertices.
        body: anatomy of all vertices.
        count: number of vertices of the body before its edges were split; they are the first ones in `colors`.
        average: function that averages values of these first vertices over their neighbours.
        carried: function that interpolates values of these first vertices to all vertices.
    """
    grey = float(linear_from_bytes(torch.tensor(BLANK, dtype=torch.uint8)))
    blank = np.asarray(np.abs(colors - grey).max(1) < 0.002)
    face = ~blank & (body.head > 0.5) & (body.on_head[:, 2] > 0.2)
    if not blank.any() or not face.any():
        return colors
    own, open_ = colors[:count].copy(), blank[:count]
    own[open_] = np.median(colors[face], axis=0)
    for _ in range(40):
        own[open_] = average(own)[open_]
    # a midpoint between a blank and a painted vertex is interpolated from both
    near = carried(np.where(open_, 1.0, 0.0)) > 0
    return np.where((blank | near)[:, None], carried(own), colors)


def paint_skin(body: Anatomy, random: Generator) -> Float[np.ndarray, "vertices 3"]:
    """Return the linear RGB of every vertex of a random skin with a face."""
    tone = _tone(random)
    spots = 1 + 0.05 * noise(body.place, 0.03, random) + 0.03 * noise(body.place, 0.01, random)
    colors = tone * spots[:, None]
    return _paint_face(body, colors, tone, random) if (body.head > 0.5).any() else colors


def _tone(random: Generator) -> Color:
    depth = random.random()  # 0 is light, 1 is dark
    return hue(24 - 5 * depth, 0.3 + 0.35 * depth, 0.95 - 0.6 * depth)


def _paint_face(body: Anatomy, colors: np.ndarray, tone: Color, random: Generator) -> np.ndarray:
    """Return colours with lips, cheeks, brows, eyes and shade around them, at their positions on the head."""
    x, y, z = body.on_head.T
    face = (body.head > 0.5) & (z > 0.35)
    side = np.abs(x)

    def blot(at: tuple[float, float], wide: float, high: float) -> np.ndarray:
        return face * np.exp(-(((side - at[0]) / wide) ** 2) - ((y - at[1]) / high) ** 2)

    lips = blot((0.0, 0.19), 0.22, 0.026) ** 0.7
    cheeks = blot((0.45, 0.35), 0.18, 0.08)
    sockets = blot((0.36, 0.485), 0.2, 0.045)
    brow = face & (np.abs(y - 0.56 + 0.25 * (side - 0.36) ** 2) < 0.014) & (np.abs(side - 0.36) < 0.22)
    stubble = (random.random() < 0.25) * face * ((y < 0.28) & (side < 0.75)) * (1 - lips)
    colors = colors * (1 - 0.25 * sockets)[:, None]
    colors = colors + (np.array([0.12, 0.0, 0.0]) * tone)[None] * cheeks[:, None]
    colors = colors * (1 - 0.7 * lips[:, None] * (1 - np.array([0.85, 0.4, 0.42])))
    colors = np.where(brow[:, None], 0.25 * tone, colors)
    return paint_eyes(body, colors * (1 - 0.5 * stubble)[:, None], random)


def paint_eyes(body: Anatomy, colors: np.ndarray, random: Generator) -> Float[np.ndarray, "vertices 3"]:
    """Return colours with the white, the iris and the pupil of both eyes, at their positions on the head."""
    x, y, z = body.on_head.T
    face = (body.head > 0.5) & (z > 0.35)
    away = (np.abs(x) - 0.355, y - 0.482)
    colour = hue(random.choice([25.0, 30.0, 205.0, 110.0]), 0.5, random.uniform(0.2, 0.5)) * 0.6
    for wide, high, paint in ((0.13, 0.022, 0.7), (0.055, 0.024, colour), (0.02, 0.009, 0.01)):
        colors = np.where((face & (np.hypot(away[0] / wide, away[1] / high) < 1))[:, None], paint, colors)
    return colors
