"""The skin of generated people: painted by procedure, or a picture in the body's own texture layout."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.random import Generator

from framework.datasets import images
from framework.errors import DataError
from framework.geometry.light import linear
from plugins.data.bodies.anatomy import Anatomy
from plugins.data.bodies.fabrics import Color, hue, noise


def files(folder: Path) -> list[Path]:
    """Pictures of a folder, by name.

    Raises:
        DataError: no such folder, or no PNG in it.
    """
    found = sorted(folder.glob("*.png"))
    if not found:
        raise DataError(
            f"data.skins = {folder}: no PNG there; wanted a folder of skins in the default body's texture layout, or null."
        )
    return found


def read(file: Path) -> UInt8[np.ndarray, "height width 3"]:
    """A skin's pixels.

    Raises:
        DataError: the file is damaged.
    """
    with images.opened(file) as image:
        return np.array(images.plain(image, 3, upright=False))


def shown(
    pixels: UInt8[np.ndarray, "height width 3"], uv: Float[np.ndarray, "places 2"]
) -> Float[np.ndarray, "places 3"]:
    """Linear light of a skin at places, interpolated between texels; v upwards."""
    light = linear(torch.from_numpy(pixels)).numpy()
    height, width = light.shape[:2]
    x = (uv[:, 0] * width - 0.5).clip(0, width - 1.001)
    y = ((1 - uv[:, 1]) * height - 0.5).clip(0, height - 1.001)
    column, row = x.astype(np.int64), y.astype(np.int64)
    right, down = (x - column)[:, None], (y - row)[:, None]
    below, beside = np.minimum(row + 1, height - 1), np.minimum(column + 1, width - 1)
    top = light[row, column] * (1 - right) + light[row, beside] * right
    bottom = light[below, column] * (1 - right) + light[below, beside] * right
    return top * (1 - down) + bottom * down


def painted(body: Anatomy, random: Generator) -> Float[np.ndarray, "vertices 3"]:
    """Skin with a face, linear light of every vertex."""
    tone = _tone(random)
    spots = 1 + 0.05 * noise(body.place, 0.03, random) + 0.03 * noise(body.place, 0.01, random)
    found = tone * spots[:, None]
    return _with_face(body, found, tone, random) if (body.head > 0.5).any() else found


def _tone(random: Generator) -> Color:
    depth = random.random()  # from light to dark
    return hue(24 - 5 * depth, 0.3 + 0.35 * depth, 0.95 - 0.6 * depth)


def _with_face(body: Anatomy, found: np.ndarray, tone: Color, random: Generator) -> np.ndarray:
    """Lips, cheeks, brows, eyes and shade about them, at their places on the head."""
    x, y, z = body.on_head.T
    face = (body.head > 0.5) & (z > 0.35)
    side = np.abs(x)

    def blot(at: tuple[float, float], wide: float, high: float) -> np.ndarray:
        return face * np.exp(-(((side - at[0]) / wide) ** 2) - ((y - at[1]) / high) ** 2)

    lips = blot((0, 0.19), 0.22, 0.026) ** 0.7
    cheeks = blot((0.45, 0.35), 0.18, 0.08)
    sockets = blot((0.36, 0.485), 0.2, 0.045)
    brow = face & (np.abs(y - 0.56 + 0.25 * (side - 0.36) ** 2) < 0.014) & (np.abs(side - 0.36) < 0.22)
    stubble = (random.random() < 0.25) * face * ((y < 0.28) & (side < 0.75)) * (1 - lips)
    found = found * (1 - 0.25 * sockets)[:, None]
    found = found + (np.array([0.12, 0.0, 0.0]) * tone)[None] * cheeks[:, None]
    found = found * (1 - 0.7 * lips[:, None] * (1 - np.array([0.85, 0.4, 0.42])))
    found = np.where(brow[:, None], 0.25 * tone, found)
    found = found * (1 - 0.5 * stubble)[:, None]
    open_eye = face & (np.hypot((side - 0.355) / 0.13, (y - 0.482) / 0.022) < 1)
    iris = open_eye & (np.hypot((side - 0.355) / 0.055, (y - 0.482) / 0.024) < 1)
    colour = hue(random.choice([25, 30, 205, 110]), 0.5, random.uniform(0.2, 0.5))
    found = np.where(open_eye[:, None], 0.75, found)
    return np.where(iris[:, None], colour * 0.6, found)
