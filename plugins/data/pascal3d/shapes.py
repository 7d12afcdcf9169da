"""Closed solids from which the object families are built: boxes, lofts, solids of revolution, rings and plates.

Object coordinates are those of PASCAL3D+ models: the front faces -y, z points up, and x to the left of the object.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Number = float | int
Points = Sequence[Any] | NDArray[Any]
"""Point (3,), or a list of points (points, 3), or a list of such lists."""
Color = tuple[float, float, float]


@dataclass(frozen=True)
class Solid:
    """Closed surface, which is shaded smoothly across edges whose facets share vertices.

    Attributes:
        vertices: Vertices, (vertices, 3).
        faces: Vertex indices, (faces, 3), all clockwise or all counter-clockwise seen from outside; `Body.mesh` finds
            out which.
    """

    vertices: Array
    faces: NDArray[np.int64]


@dataclass(frozen=True)
class Mesh:
    """Coloured object, whose bounding box is centred at the origin and has a diagonal of length 1.

    Attributes:
        vertices: Vertices, (vertices, 3).
        faces: Vertex indices, (faces, 3), counter-clockwise seen from outside.
        colors: Reflectances in [0, 1], (vertices, 3).
        normals: Outward unit normals, (vertices, 3).
    """

    vertices: Array
    faces: NDArray[np.int64]
    colors: Array
    normals: Array


class Body:
    """Collection of coloured solids that become one mesh."""

    def __init__(self) -> None:
        self._solids: list[Solid] = []
        self._colors: list[Color] = []

    def add(self, solid: Solid, color: Color) -> None:
        """Add a solid of one colour."""
        self._solids.append(solid)
        self._colors.append(color)

    def pair(self, solid: Solid, color: Color) -> None:
        """Add a solid and its mirror image in x."""
        self.add(solid, color)
        self.add(transform(solid, scale=(-1.0, 1.0, 1.0)), color)

    def rotated_copies(self, *angles: Number) -> "Body":
        """Return a body of one copy of this body for each angle (radians), rotated by this angle about z."""
        whole = Body()
        for angle in angles:
            cos, sin = np.cos(angle), np.sin(angle)
            rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
            for solid, color in zip(self._solids, self._colors, strict=True):
                whole.add(Solid(solid.vertices @ rotation.T, solid.faces), color)
        return whole

    def mesh(self) -> Mesh:
        """Return all solids as one centred and scaled mesh, with faces counter-clockwise seen from outside."""
        counts = [len(solid.vertices) for solid in self._solids]
        starts = np.cumsum([0, *counts[:-1]])
        vertices = np.concatenate([solid.vertices for solid in self._solids])
        faces = np.concatenate([s.faces + start for s, start in zip(self._solids, starts, strict=True)])
        colors = np.repeat(np.array(self._colors), counts, axis=0)
        low, high = vertices.min(0), vertices.max(0)
        vertices = (vertices - (low + high) / 2) / np.linalg.norm(high - low)

        first, second, third = (vertices[faces[:, corner]] for corner in range(3))
        normal = np.cross(second - first, third - first)  # length: twice the area
        # A closed surface whose faces run clockwise has a negative volume (divergence theorem).
        owner = np.repeat(np.arange(len(counts)), [len(solid.faces) for solid in self._solids])
        volume = np.bincount(owner, (normal * first).sum(1))
        outward = np.sign(volume)[owner]
        faces = np.where(outward[:, None] < 0, faces[:, ::-1], faces)
        normal *= outward[:, None]

        index = faces.ravel()
        summed = np.stack(
            [np.bincount(index, np.repeat(normal[:, axis], 3), len(vertices)) for axis in range(3)], axis=1
        )
        return Mesh(
            vertices, faces, colors, summed / np.maximum(np.linalg.norm(summed, axis=1)[:, None], 1e-12)
        )


def transform(solid: Solid, *, scale: Points = (1.0, 1.0, 1.0), shift: Points = (0.0, 0.0, 0.0)) -> Solid:
    """Return the solid scaled along each axis and then shifted."""
    return Solid(solid.vertices * np.asarray(scale) + np.asarray(shift), solid.faces)


def offset_point(point: Points, x: Number, y: Number, z: Number) -> Array:
    """Return a point shifted by (x, y, z)."""
    return np.asarray(point) + np.array([x, y, z])


def box(size: Points, center: Points) -> Solid:
    """Return an upright box of size (width in x, length in y, height in z)."""
    return transform(_unit_box(), scale=size, shift=center)


@cache
def _unit_box() -> Solid:
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
    return loft([np.insert(square, 2, height, axis=1) for height in (-0.5, 0.5)])


def loft(rings: Points, *, smooth: bool = False) -> Solid:
    """Return the surface through a stack of rings (rings, points, 3), closed by a flat cap at either end.

    A ring may shrink to a point. With `smooth`, the side is shaded smoothly, but not across the rim of a cap.
    """
    stack = np.asarray(rings, dtype=np.float64)
    layers, points, _ = stack.shape
    if smooth:
        side = stack
    else:
        after = np.roll(stack, -1, axis=1)
        side = np.stack([stack[:-1], after[:-1], after[1:], stack[1:]], axis=2)
    vertices = np.concatenate([side.reshape(-1, 3), stack[0], stack[-1]])
    return Solid(vertices, _loft_faces(layers, points, smooth))


@cache
def _loft_faces(layers: int, points: int, smooth: bool) -> NDArray[np.int64]:
    if smooth:
        quads, side = _quads(layers, points, closed=False), layers * points
    else:
        quads = np.arange(4 * (layers - 1) * points).reshape(-1, 4)
        side = quads.size
    fan = np.stack([np.zeros(points - 2, int), np.arange(1, points - 1), np.arange(2, points)], axis=1)
    caps = [fan[:, ::-1] + side, fan + side + points]
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]], *caps])


def _quads(layers: int, points: int, *, closed: bool) -> NDArray[np.int64]:
    """Return the corner indices (quads, 4) of the quads between rings; `closed` joins the last ring to the first."""
    layer, point = np.meshgrid(np.arange(layers if closed else layers - 1), np.arange(points), indexing="ij")
    above, after = (layer + 1) % layers, (point + 1) % points
    corners = [layer * points + point, layer * points + after, above * points + after, above * points + point]
    return np.stack(corners, axis=-1).reshape(-1, 4)


@cache
def _circle(sides: int) -> Array:
    angle = 2 * np.pi * np.arange(sides) / sides
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def lathe(profile: Sequence[tuple[Number, Number]], sides: int = 24) -> Solid:
    """Return a solid of revolution about z; the profile is a list of (radius, height), from bottom to top."""
    rings = np.empty((len(profile), sides, 3))
    for layer, (radius, height) in enumerate(profile):
        rings[layer, :, :2] = radius * _circle(sides)
        rings[layer, :, 2] = height
    return loft(rings, smooth=True)


def rod(
    start: Points, end: Points, radius: Number, end_radius: Number | None = None, sides: int = 6
) -> Solid:
    """Return a straight round bar, or a frustum of a cone if `end_radius` differs from `radius`."""
    first, last = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    x, y, z = (last - first).tolist()
    length, flat = math.hypot(x, y, z), math.hypot(y, z)
    # two unit vectors across the bar; one of them lies in the plane x = 0 unless the bar runs along x
    across = (0.0, z / flat, -y / flat) if flat > 1e-9 * length else (0.0, 1.0, 0.0)
    upward = (
        (y * across[2] - z * across[1]) / length,
        (z * across[0] - x * across[2]) / length,
        (x * across[1] - y * across[0]) / length,
    )
    circle = _circle(sides) @ np.array([across, upward])
    radii = (radius, radius if end_radius is None else end_radius)
    return loft([first + radii[0] * circle, last + radii[1] * circle], smooth=sides > 6)


def wheel(center: Points, radius: Number, width: Number, sides: int = 16) -> Solid:
    """Return a disc whose axis is parallel to x."""
    middle = np.asarray(center, dtype=np.float64)
    half = np.array([width / 2, 0, 0])
    return rod(middle - half, middle + half, radius, sides=sides)


def ring(center: Points, radius: Number, thickness: Number, sides: int = 20, around: int = 5) -> Solid:
    """Return a torus whose axis is parallel to x.

    `radius` is the distance from the axis to the middle of the tube, and `thickness` the diameter of the tube.
    """
    out, along = _circle(sides), _circle(around)
    distance = radius + thickness / 2 * along[:, 0]
    vertices = np.empty((sides, around, 3))
    vertices[..., 0] = thickness / 2 * along[:, 1]
    vertices[..., 1] = distance * out[:, :1]
    vertices[..., 2] = distance * out[:, 1:]
    return Solid(vertices.reshape(-1, 3) + np.asarray(center), _ring_faces(sides, around))


@cache
def _ring_faces(sides: int, around: int) -> NDArray[np.int64]:
    quads = _quads(sides, around, closed=True)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def ellipsoid(center: Points, radii: Points, sides: int = 14, layers: int = 9) -> Solid:
    """Return an ellipsoid with half axes `radii`."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, layers)
    unit = lathe([(float(np.cos(a)), float(np.sin(a))) for a in angle], sides)
    return transform(unit, scale=radii, shift=center)


def plate(outline: Points, offset: Points) -> Solid:
    """Return a plate: a convex plane outline (points, 3), thickened by the vector `offset`, half to either side."""
    points, half = np.asarray(outline, dtype=np.float64), np.asarray(offset, dtype=np.float64) / 2
    return loft([points - half, points + half])


def side_plate(outline: Sequence[tuple[Number, Number]], x: Number, thickness: Number) -> Solid:
    """Return a plate in the plane x = `x` with a convex outline (y, z)."""
    return plate([(x, y, z) for y, z in outline], (thickness, 0, 0))


def loft_rectangles(levels: Sequence[tuple[Number, Number, Number, Number]], middle: Number = 0.0) -> Solid:
    """Return the solid through a stack of horizontal rectangles (half width, front y, rear y, z) about x = `middle`."""
    rings = [
        [(middle + half, near, z), (middle + half, far, z), (middle - half, far, z), (middle - half, near, z)]
        for half, near, far, z in levels
    ]
    return loft(rings)


def bevelled(width: Number, low: Number, high: Number, y: Number, bevel: Number = 0.25) -> Array:
    """Return a ring (8, 3) in the plane of this y: a rectangle with cut corners.

    `low` and `high` are its limits in z. The cut has the length of `bevel` times the shorter half side.
    """
    half, middle, tall = width / 2, (low + high) / 2, (high - low) / 2
    cut = bevel * min(half, tall)
    plan = [
        (half - cut, -tall), (half, -tall + cut), (half, tall - cut), (half - cut, tall),
        (-half + cut, tall), (-half, tall - cut), (-half, -tall + cut), (-half + cut, -tall),
    ]  # fmt: skip
    return np.array([(x, y, middle + z) for x, z in plan])
