"""Procedural cloth: band-limited noise, folds, and patterns that are finer than the spacing of a mesh's vertices."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from numpy.random import Generator

Color = Float[np.ndarray, "3"]
"""Linear RGB in [0, 1]."""
WAVES = 10
"""Number of plane waves of a noise."""


def hue(degrees: float | int, saturation: float | int, value: float | int) -> Color:
    """Return the linear RGB of the sRGB colour with a hue (degrees), a saturation and a value (0 to 1)."""
    sector = (np.array([5.0, 3.0, 1.0]) + degrees / 60) % 6
    return (value * (1 - saturation * np.minimum(sector, 4 - sector).clip(0, 1))) ** 2.2


def dye(random: Generator) -> Color:
    """Return a random colour typical of clothes: mostly muted, often black, white or grey."""
    kind = random.random()
    if kind < 0.2:
        return hue(220, 0.1, random.uniform(0.1, 0.25))
    if kind < 0.38:
        return hue(40, 0.06, random.uniform(0.8, 0.95))
    if kind < 0.48:
        return hue(30, 0.05, random.uniform(0.35, 0.6))
    return hue(random.uniform(0, 360), random.uniform(0.25, 0.85), random.uniform(0.3, 0.85))


def noise(
    place: Float[np.ndarray, "points 3"],
    wavelength: float,
    random: Generator,
    squeezed: tuple[float, float, float] = (1.0, 1.0, 1.0),
    waves: int = WAVES,
) -> Float[np.ndarray, "points"]:
    """Return smooth noise of standard deviation 1 at the given positions.

    It is a sum of plane waves in random directions, whose wavelengths differ from `wavelength` (metres) at most by the
    factor 1.5. Along x, y and z the wavelength is divided by the numbers in `squeezed`.
    """
    direction = random.normal(size=(3, waves))
    direction /= np.linalg.norm(direction, axis=0)
    number = 2 * np.pi / (wavelength * 1.5 ** random.uniform(-1, 1, waves))
    phase = random.uniform(0, 2 * np.pi, waves)
    return _sum_waves(place, direction * number * np.array(squeezed)[:, None], phase) * (2 / waves) ** 0.5


def folds(
    place: Float[np.ndarray, "points 3"],
    wavelength: float,
    across: tuple[float, float, float],
    random: Generator,
) -> Float[np.ndarray, "points"]:
    """Return the heights of random wrinkles at the given positions: ridges about 1 high between wide valleys.

    The mean is near 0. The ridges are perpendicular to `across` and about `wavelength` (metres) from each other.
    """
    direction = np.array(across)[:, None] + 0.35 * random.normal(size=(3, 5))
    direction /= np.linalg.norm(direction, axis=0)
    number = 2 * np.pi / (wavelength * 1.4 ** random.uniform(-1, 1, 5))
    bent = place + 0.2 * wavelength * noise(place, 3 * wavelength, random, waves=5)[:, None]
    phase = random.uniform(0, 2 * np.pi, 5)
    waves = _sum_waves(bent, direction * number, phase) * 0.63
    come_and_go = (0.5 + 0.6 * noise(place, 2.2 * wavelength, random, waves=5)).clip(0, 1.2)
    return (np.exp(0.9 * waves.clip(-2, 1.2)) - 1.2) * 0.6 * come_and_go


def _sum_waves(place: np.ndarray, waves: Float[np.ndarray, "3 waves"], phases: np.ndarray) -> np.ndarray:
    """Return the sum of the sine waves sin(wave · point + phase) at each point.

    The waves are added one after the other, which keeps the arrays in the processor's cache.
    """
    points = np.ascontiguousarray(place, np.float32)
    total, term = np.zeros((2, len(points)), np.float32)
    for wave, phase in zip(waves.T.astype(np.float32), phases.astype(np.float32), strict=True):
        np.dot(points, wave, out=term)
        term += phase
        total += np.sin(term, out=term)
    return total


Pattern = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function from coordinates across and along a piece of cloth (points,), metres, to colours (points, 3)."""


def pattern(random: Generator) -> Pattern:
    """Return a random pattern of cloth."""
    first, second, third = dye(random), dye(random), dye(random)
    if np.abs(first - second).max() < 0.15:
        second = (1 - first) * 0.8
    kind = random.choice(
        [
            "plain",
            "plain",
            "plain",
            "plain",
            "stripes",
            "upright",
            "check",
            "dots",
            "blocks",
            "melange",
            "zigzag",
        ]
    )
    width, share = random.uniform(0.02, 0.09), random.uniform(0.25, 0.6)
    if kind in ("dots", "upright"):
        width = random.uniform(0.025, 0.06)

    def colors(across: np.ndarray, along: np.ndarray) -> np.ndarray:
        if kind == "stripes":
            where = _band(along, width, share)
        elif kind == "upright":
            where = _band(across, width, share)
        elif kind == "zigzag":
            where = _band(along + 0.4 * np.abs((across / width) % 2 - 1) * width, width, share)
        elif kind == "check":
            where = 0.5 * _band(along, width, 0.5) + 0.5 * _band(across, width, 0.5)
        elif kind == "dots":
            odd = np.floor(along / width) % 2
            x, y = (across / width + odd / 2) % 1 - 0.5, (along / width) % 1 - 0.5
            where = (np.hypot(x, y) < 0.15 + 0.25 * share).astype(float)
        elif kind == "blocks":
            where = (along > np.median(along)).astype(float)
        elif kind == "melange":
            where = 0.2 + 0.1 * np.sin(330 * across) * np.sin(270 * along + 90 * across)
        else:
            where = np.zeros(len(across))
        mixed = first + where[:, None] * (second - first)
        if kind == "check":
            line = _band(along, width, 0.08) + _band(across, width, 0.08)
            mixed = np.where(line[:, None] > 0, third, mixed)
        return mixed

    return colors


def _band(values: np.ndarray, width: float, share: float) -> np.ndarray:
    return ((values / width) % 1 < share).astype(float)
