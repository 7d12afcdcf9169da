"""Mesh of a skirt: rings around both legs, from the waist down, at least as wide as the legs inside."""

import numpy as np
from jaxtyping import Bool, Float
from numpy.random import Generator

from plugins.data.human_scans.fabrics import noise
from plugins.data.human_scans.garments import Skirt
from plugins.data.human_scans.hair import Piece, grid

RINGS, AROUND = 90, 241
"""Number of rings from the waist down, and of vertices of a ring; its last vertex coincides with its first."""
SLICE = 0.035
"""Half the height of the slice of a body that a ring has to enclose, metres."""
OFF = 0.012
"""Distance of the skirt from the body inside, metres."""


def hang_skirt(
    skirt: Skirt,
    trunk_and_legs: Float[np.ndarray, "vertices 3"],
    top: Bool[np.ndarray, "vertices"],
    random: Generator,
) -> Piece:
    """Return the mesh of a skirt on a posed body.

    Args:
        skirt: the skirt.
        trunk_and_legs: posed vertices of trunk and legs, metres.
        top: whether each of these vertices lies at the skirt's upper border.
        random: source of the folds.
    """
    waist = trunk_and_legs[top].mean(0)
    angle = np.linspace(0, 2 * np.pi, AROUND)
    directions = np.stack([np.sin(angle), np.cos(angle)], 1)
    heights = waist[1] - skirt.length * np.linspace(0, 1, RINGS)
    flat = trunk_and_legs[:, [0, 2]] - waist[[0, 2]]
    reach = np.zeros((RINGS, AROUND))
    for ring, height in enumerate(heights):
        near = np.abs(trunk_and_legs[:, 1] - height) < SLICE
        # the farthest extent of the slice in every direction: at least the outline of a cloth pulled tight around it
        reach[ring] = (flat[near] @ directions.T).max(0) if near.any() else 0.0
    reach = np.maximum(_smooth(reach), 0.0) + OFF
    step = skirt.length / (RINGS - 1)
    for ring in range(1, RINGS):  # the radius decreases downwards by a little at most
        reach[ring] = np.maximum(reach[ring], reach[ring - 1] + (skirt.flare - 0.08) * step)
    down = np.linspace(0, 1, RINGS)[:, None]
    wave = np.sin(skirt.pleats * angle + 1.5 * np.sin(2 * angle + random.uniform(0, 6)) + 2 * down)
    radius = reach + skirt.depth * (0.1 + down) * (1 + wave)
    radius[:, -1] = radius[:, 0]
    vertices = np.stack(
        [
            waist[0] + radius * np.sin(angle),
            np.broadcast_to(heights[:, None], radius.shape),
            waist[2] + radius * np.cos(angle),
        ],
        -1,
    ).reshape(-1, 3)
    across = np.broadcast_to(0.16 * (angle - np.pi), radius.shape).ravel()
    along = np.broadcast_to(skirt.length * down, radius.shape).ravel()
    colors = skirt.cloth(across, -along)
    shade = 1 + 0.1 * wave.ravel() + 0.04 * noise(vertices, 0.01, random)
    border = np.where((along > skirt.length - 0.012) | (along < 0.025), 0.75, 1.0)
    return Piece(
        vertices, grid(RINGS, AROUND)[:, ::-1], (colors * (shade * border)[:, None]).clip(0.004, 0.95)
    )


def _smooth(values: np.ndarray) -> np.ndarray:
    """Return the radii of the rings, smoothed over neighbours around the ring and along the height."""
    for _ in range(4):
        inner = values[:, :-1]
        inner = (np.roll(inner, 1, 1) + 2 * inner + np.roll(inner, -1, 1)) / 4
        values = np.concatenate([inner, inner[:, :1]], 1)
        padded = np.pad(values, ((1, 1), (0, 0)), mode="edge")
        values = (padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4
    return values
