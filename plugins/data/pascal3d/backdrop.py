"""Surroundings of an object: textures, a horizon, clutter, and shapes in front of the object."""

import math

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image, ImageDraw

FloatImage = NDArray[np.float32]
"""Image with values 0…1; (height, width, 3) unless stated otherwise.

Images that are mixed with others are views of arrays (3, height, width), because NumPy computes long rows many times
faster than rows of three numbers.
"""


def texture(random: Generator, height: int, width: int) -> FloatImage:
    """Return smooth noise on three scales between two random colours."""
    noise = np.zeros((height, width), np.float32)
    for cells, weight in ((3, 1.0), (9, 0.5), (30, 0.3)):
        grid = random.random((cells, cells), dtype=np.float32) - np.float32(0.5)
        noise += weight * np.asarray(Image.fromarray(grid).resize((width, height), Image.Resampling.BICUBIC))
    share = np.clip(noise + np.float32(0.5), 0, 1)
    first = muted_color(random)[:, None, None]
    second = np.clip(first + random.normal(0, 0.2, 3).astype(np.float32)[:, None, None], 0, 1)
    return np.moveaxis(np.asarray(first + share * (second - first), dtype=np.float32), 0, 2)


def muted_color(random: Generator) -> FloatImage:
    """Return a random colour (3,) of any brightness and little saturation."""
    grey = random.uniform(0.12, 0.9)
    return np.clip(grey + random.normal(0, 0.1, 3), 0, 1).astype(np.float32)


def background(
    random: Generator, height: int, width: int, horizon: tuple[float, float], tilt: float
) -> FloatImage:
    """Return a texture, or ground and sky that meet at the horizon, with clutter.

    Args:
        random: Source of all random numbers.
        height: Height of the image, pixels.
        width: Width of the image, pixels.
        horizon: A point of the horizon (x, y), pixels.
        tilt: Angle of the horizon to the horizontal, radians, counter-clockwise in the image.
    """
    ground = texture(random, height, width)
    if random.random() < 0.5:
        sky = 0.5 * texture(random, height, width) + np.float32(0.45)
        y, x = np.mgrid[:height, :width].astype(np.float32)
        above = (y - horizon[1]) * math.cos(tilt) + (x - horizon[0]) * math.sin(tilt)
        share = np.clip(above / 2 + 0.5, 0, 1)[..., None]
        ground = sky + share * (ground - sky)
    for _ in range(int(random.integers(0, 5))):
        mask = blob(random, height, width, (random.uniform(0, width), random.uniform(0, height)), 0.5 * width)
        ground += 0.85 * mask[..., None] * (muted_color(random) - ground)
    return ground


def blob(
    random: Generator, height: int, width: int, center: tuple[float, float], size: float
) -> NDArray[np.float32]:
    """Return the mask of a random ellipse, quadrangle or pole near `center`, at most about `size` pixels across."""
    canvas = Image.new("L", (width, height))
    draw = ImageDraw.Draw(canvas)
    x, y = center
    across, along = random.uniform(0.1, 0.5, 2) * size
    kind = random.random()
    if kind < 0.35:
        draw.ellipse((x - across, y - along, x + across, y + along), fill=255)
    elif kind < 0.75:
        angle = random.uniform(0, math.pi)
        corners = [(-across, -along), (across, -along), (across, along), (-across, along)]
        cos, sin = math.cos(angle), math.sin(angle)
        draw.polygon([(x + u * cos - v * sin, y + u * sin + v * cos) for u, v in corners], fill=255)
    else:
        thick = 0.06 * size
        draw.rectangle((x - thick, 0, x + thick, height), fill=255)
    return np.asarray(canvas, dtype=np.float32) / np.float32(255)
