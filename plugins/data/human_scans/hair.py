"""Hair of generated people: volume over the scalp with strands, and separate meshes of long hair, tails and buns."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.random import Generator

from plugins.data.human_scans.anatomy import Anatomy
from plugins.data.human_scans.fabrics import Color, hue, noise

Style = Literal["none", "short", "full", "round", "long", "tail", "bun"]
STYLES: tuple[Style, ...] = ("none", "short", "full", "round", "long", "tail", "bun")
SHARES = (0.06, 0.26, 0.16, 0.1, 0.2, 0.12, 0.1)
LINE = ((-1, -0.35, -0.2, 0.1, 0.35, 0.7, 1), (0.16, 0.2, 0.52, 0.62, 0.7, 0.8, 0.83))
"""Points of the hairline at the side of a head: their coordinates z and y, as in `Anatomy.on_head`."""
HEAD = 0.23
"""Height of a head, metres, which converts distances from the hairline."""


class Hair(NamedTuple):
    """Hair that grows on the scalp.

    Attributes:
        style: name of the hairstyle.
        color: linear RGB.
        share: share of the skin that hair covers at each vertex: 1 in the hair, 0 outside, between 0 and 1 at the
            border.
        raised: height above the scalp, metres.
        colors: linear RGB of every vertex.
    """

    style: Style
    color: Color
    share: Float[np.ndarray, "vertices"]
    raised: Float[np.ndarray, "vertices"]
    colors: Float[np.ndarray, "vertices 3"]


class Piece(NamedTuple):
    """Separate mesh beside the body, metres; triangles are counter-clockwise seen from outside, colours linear RGB."""

    vertices: Float[np.ndarray, "vertices 3"]
    faces: np.ndarray
    colors: Float[np.ndarray, "vertices 3"]


def hair(body: Anatomy, random: Generator) -> Hair:
    """Return the random hair of one person."""
    style: Style = STYLES[int(random.choice(len(STYLES), p=SHARES))]
    color = _shade(random)
    x, y, z = body.on_head.T
    low = {"full": 0.12, "long": 0.12, "round": 0.05}.get(style, 0.0)
    # hair that is long enough covers the ears, but not the face
    line = np.interp(z, *LINE) - low * ((z > -0.3) & (z < 0.32))
    line = line - random.uniform(-0.02, 0.03)
    inside = np.where(body.head > 0.5, (y - line) * HEAD, -1.0)
    share = (inside / 0.012 + 0.5).clip(0, 1) * (style != "none")
    volume = {
        "none": 0.0,
        "short": 0.012,
        "full": 0.03,
        "round": 0.045,
        "long": 0.028,
        "tail": 0.012,
        "bun": 0.012,
    }
    height = volume[style] * random.uniform(0.8, 1.3)
    swell = np.sqrt((inside / 0.05).clip(0, 1))  # rises steeply from the hairline
    curls = (
        noise(body.place, 0.014, random)
        if style == "round"
        else noise(body.place, 0.02, random, (2.0, 0.3, 2.0))
    )
    raised = (
        share * height * (0.35 + 0.65 * swell) * (1 + 0.12 * curls + 0.1 * noise(body.place, 0.06, random))
    )
    squeeze = (1.0, 1.0, 1.0) if style == "round" else (1.5, 0.15, 1.5)
    strands = (
        1 + 0.22 * noise(body.place, 0.009, random, squeeze) + 0.12 * noise(body.place, 0.03, random, squeeze)
    )
    parting = random.uniform(-0.5, 0.5)
    if style in ("full", "long"):
        line_of_scalp = (np.abs(x - parting) < 0.025) & (y > 0.8) & (z > -0.3)
        strands = np.where(line_of_scalp, 0.6, strands)
    return Hair(style, color, share, raised, (color * strands[:, None]).clip(0.003, 0.9))


def _shade(random: Generator) -> Color:
    kind = random.random()
    if kind < 0.45:
        return hue(random.uniform(15, 35), random.uniform(0.3, 0.6), random.uniform(0.12, 0.3))
    if kind < 0.7:
        return hue(random.uniform(20, 32), random.uniform(0.45, 0.65), random.uniform(0.32, 0.5))
    if kind < 0.86:
        return hue(random.uniform(35, 45), random.uniform(0.35, 0.55), random.uniform(0.65, 0.85))
    if kind < 0.92:
        return hue(random.uniform(10, 18), 0.7, random.uniform(0.45, 0.6))
    return hue(40, 0.05, random.uniform(0.5, 0.85))


def tie_hair(
    style: Style,
    color: Color,
    head: Float[np.ndarray, "4 3"],
    lie_of_head: Float[np.ndarray, "3 2"],
    random: Generator,
) -> Piece | None:
    """Return the mesh of hair that hangs from the head or is tied to it; None for styles without such hair.

    `head` is the affine transform from (x, y, z, 1) of the template to the posed head. `lie_of_head` holds the smallest
    and largest x, y, z of the head in the template.
    """
    middle, half = lie_of_head.mean(1), (lie_of_head[:, 1] - lie_of_head[:, 0]) / 2
    if style == "long":
        piece = _curtain(middle, half, random)
    elif style == "tail":
        piece = _tail(middle, half, random)
    elif style == "bun":
        piece = _bun(middle, half, random)
    else:
        return None
    place, faces, across = piece
    waves = [
        noise(np.stack([across, 0.05 * place[:, 1], 0 * across], 1), length, random)
        for length in (0.008, 0.03)
    ]
    colors = color * (1 + 0.22 * waves[0] + 0.14 * waves[1])[:, None]
    placed = np.concatenate([place, np.ones((len(place), 1))], 1) @ head
    return Piece(placed, faces, colors.clip(0.003, 0.9))


def grid(rows: int, columns: int) -> np.ndarray:
    """Return the triangles of a grid of vertices, row by row; it is closed if the first and last columns coincide."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    halves = [(0, 1, columns), (1, columns + 1, columns)]
    return np.concatenate([corner[:, None] + half for half in halves])


def _curtain(
    middle: np.ndarray, half: np.ndarray, random: Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return long hair, which hangs down around the back of the head from ear to ear.

    Args:
        middle: centre of the head.
        half: half width, half height and half depth of the head.
        random: source of the random shape.

    Returns:
        Vertices, triangles, and the coordinate of each vertex across the strands, metres.
    """
    length, reach = random.uniform(0.2, 0.42), random.uniform(1.5, 1.9)
    angle, down = np.meshgrid(np.linspace(-reach, reach, 120), np.linspace(0, 1, 60))
    lock = 0.006 * np.sin(9 * angle + 3 * np.sin(2 * angle) + random.uniform(0, 6))
    out = 0.022 + lock + 0.004 * np.sin(14 * down + 5 * angle)
    wide, deep = half[0] + out, 0.75 * half[2] + out
    # the hair is narrower at the neck and closes towards its end
    taper = 1 - 0.18 * np.exp(-(((down - 0.45) / 0.25) ** 2)) - 0.35 * (down - 0.75).clip(0, None)
    ends = 1 - 0.12 * np.abs(np.sin(7 * angle + 1.3)) * (down > 0.8)
    height = middle[1] + 0.35 * half[1] - length * 1.2 * down * ends
    place = np.stack(
        [
            middle[0] - wide * taper * np.sin(angle),
            height,
            middle[2] - 0.15 * half[2] - deep * taper * np.cos(angle),
        ],
        -1,
    )
    return place.reshape(-1, 3), grid(*angle.shape), (0.1 * angle).ravel()


def _tail(
    middle: np.ndarray, half: np.ndarray, random: Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a tail that hangs down from the back of the head; arguments and results as for `_curtain`."""
    length, thick, high = random.uniform(0.18, 0.36), random.uniform(0.022, 0.034), random.uniform(-0.1, 0.5)
    angle, down = np.meshgrid(np.linspace(0, 2 * np.pi, 49), np.linspace(0, 1, 48))
    radius = thick * (0.45 + 1.1 * np.sqrt(down.clip(0, 1))) * np.sqrt((1 - down).clip(0.002, None)) * 1.35
    radius = radius * (1 + 0.1 * np.sin(6 * angle + 4 * down))
    back = half[2] * 0.95 + 0.05 * np.sin(np.pi * down.clip(0, 0.6) / 0.6) - 0.02 * down
    centre_y = middle[1] + high * half[1] + 0.02 - length * down**1.3
    place = np.stack(
        [
            middle[0] + radius * np.cos(angle),
            centre_y + 0.3 * radius * np.sin(angle),
            middle[2] - back - radius * np.sin(angle),
        ],
        -1,
    )
    return place.reshape(-1, 3), grid(*angle.shape), (0.03 * angle).ravel()


def _bun(
    middle: np.ndarray, half: np.ndarray, random: Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a bun, a ball at the back or on top of the head; arguments and results as for `_curtain`."""
    size, lift = random.uniform(0.032, 0.05), random.uniform(0.2, 1.3)
    angle, down = np.meshgrid(np.linspace(0, 2 * np.pi, 49), np.linspace(0, np.pi, 32))
    radius = size * (1 + 0.07 * np.sin(5 * angle + 6 * down))
    centre = middle + half * np.array([0, np.sin(lift), -np.cos(lift)]) * 1.02
    ball = np.stack([np.sin(down) * np.cos(angle), np.cos(down), np.sin(down) * np.sin(angle)], -1)
    place = centre + radius[..., None] * ball
    return place.reshape(-1, 3), grid(*angle.shape)[:, ::-1], (0.05 * (angle + 2 * down)).ravel()
