"""The solids: triangles with normals, and the group of rotations that leave each of them unchanged."""

import math
from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from framework.geometry.solids import Point
from framework.geometry.symmetry import GOLDEN

SIDES = 96
"""Number of sides of the polygons that stand for the circles of cone and cylinder."""


class ShadedSolid(NamedTuple):
    """A closed surface of triangles, centred at the origin, within the ball of radius 1.

    Attributes:
        vertices: coordinates.
        normals: unit normals at the vertices; flat faces have vertices of their own.
        faces: indices of the vertices, counter-clockwise seen from outside.
        group: name of the group of its rotations (`framework.geometry.symmetry.GROUPS`).
    """

    vertices: Float[np.ndarray, "vertices 3"]
    normals: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    group: str


@cache
def solid(name: str) -> ShadedSolid:
    """Return the solid of a name in SOLIDS."""
    return SOLIDS[name]()


def _polyhedron(corners: Sequence[Point], group: str) -> ShadedSolid:
    """Return the convex hull of `corners`, scaled to the unit sphere, with flat faces."""
    from scipy.spatial import ConvexHull  # this import takes a tenth of a second

    points = np.array(corners, dtype=np.float64)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    triangles = points[ConvexHull(points).simplices]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inward = (normals * triangles.mean(1)).sum(1) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    normals[inward] *= -1
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    count = 3 * len(triangles)
    return ShadedSolid(
        triangles.reshape(count, 3), np.repeat(normals, 3, axis=0), np.arange(count).reshape(-1, 3), group
    )


def _tetrahedron() -> ShadedSolid:
    return _polyhedron([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)], "tetrahedral")


def _cube() -> ShadedSolid:
    return _polyhedron([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], "octahedral")


def _icosahedron() -> ShadedSolid:
    pairs = [(x, y) for x in (-1, 1) for y in (-GOLDEN, GOLDEN)]
    corners = [corner for x, y in pairs for corner in ((0.0, y, x), (y, x, 0.0), (x, 0.0, y))]
    return _polyhedron(corners, "icosahedral")


def _round(profile: Sequence[tuple[float, float]], group: str) -> ShadedSolid:
    """Return the solid of revolution about z with straight sides between the (radius, height) of `profile`.

    Each side has vertices of its own, so that it is shaded smoothly around the axis and has sharp rims.
    """
    angle = 2 * math.pi * np.arange(SIDES) / SIDES
    circle = np.stack([np.cos(angle), np.sin(angle)], 1)
    vertices, normals, faces = [], [], []
    first, after = np.arange(SIDES), (np.arange(SIDES) + 1) % SIDES
    for (low_radius, low), (high_radius, high) in pairwise(profile):
        out, up = high - low, low_radius - high_radius  # the side's normal in the plane of radius and height
        length = math.hypot(out, up)
        start = 2 * SIDES * len(faces)
        for radius, height in ((low_radius, low), (high_radius, high)):
            vertices.append(np.concatenate([radius * circle, np.full((SIDES, 1), height)], 1))
            normals.append(np.concatenate([out / length * circle, np.full((SIDES, 1), up / length)], 1))
        quads = [first, after, after + SIDES, first + SIDES]
        corners = [[quads[0], quads[1], quads[2]], [quads[0], quads[2], quads[3]]]
        faces.append(start + np.concatenate([np.stack(corner, 1) for corner in corners]))
    return ShadedSolid(np.concatenate(vertices), np.concatenate(normals), np.concatenate(faces), group)


def _cone() -> ShadedSolid:
    return _round([(0.0, -0.6), (0.75, -0.6), (0.0, 0.95)], "conical")


def _cylinder() -> ShadedSolid:
    return _round([(0.0, -0.8), (0.55, -0.8), (0.55, 0.8), (0.0, 0.8)], "cylindrical")


SOLIDS = {
    "tetrahedron": _tetrahedron,
    "cube": _cube,
    "icosahedron": _icosahedron,
    "cone": _cone,
    "cylinder": _cylinder,
}
"""Names of the solids, with the function that builds each."""
