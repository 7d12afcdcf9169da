"""Closed round solids: solids of revolution, balls, tubes, bars, wheels and rings."""

import math
from collections.abc import Sequence
from functools import cache

import numpy as np
from jaxtyping import Float, Int

from framework.geometry.solids import Edges, Number, Point, Points, Solid, loft, quad_corners


@cache
def _circle(sides: int) -> Float[np.ndarray, "sides 2"]:
    angle = 2 * math.pi * np.arange(sides) / sides
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def revolution(profile: Points, sides: int = 24, edges: Edges = "shared") -> Solid:
    """Return a closed surface of revolution about z.

    Args:
        profile: (radius, height) of each ring, from bottom to top.
        sides: number of sides of a ring.
        edges: choice of the edges that are creases (`Edges`).
    """
    radius, height = np.asarray(profile, dtype=np.float64).T
    rings = np.empty((len(profile), sides, 3))
    rings[..., :2] = radius[:, None, None] * _circle(sides)
    rings[..., 2] = height[:, None]
    return loft(rings, edges)


def cylinder(
    radius: Number, height: Number, at: Point = (0, 0, 0), top: Number | None = None, sides: int = 16
) -> Solid:
    """Return an upright cylinder, or a frustum of a cone if the upper radius `top` is given.

    `at` is the middle of its bottom.
    """
    return revolution([(radius, 0), (radius if top is None else top, height)], sides).move(*at)


def ball(radius: Number, at: Point = (0, 0, 0), sides: int = 16) -> Solid:
    """Return a sphere with its centre at `at`."""
    bend = np.linspace(-math.pi / 2, math.pi / 2, sides // 2 + 1)
    return revolution([(radius * math.cos(b), radius * math.sin(b)) for b in bend], sides).move(*at)


def rod(start: Point, end: Point, radius: Number, sides: int = 8) -> Solid:
    """Return a round bar between two points."""
    return tube([start, end], [radius, radius], sides)


def ring(radius: Number, thickness: Number, at: Point = (0, 0, 0), sides: int = 24) -> Solid:
    """Return a horizontal torus with its centre at `at`; `thickness` is the radius of its tube."""
    angle = 2 * math.pi * np.arange(sides + 1) / sides
    path = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(sides + 1)])
    return tube(path, [thickness] * (sides + 1), 8).move(*at)


def tube(path: Sequence[Point] | np.ndarray, radii: Sequence[Number], sides: int = 8) -> Solid:
    """Return a round tube along a plane path or a straight line, with one radius for each point of the path."""
    points = np.asarray(path, float)
    step = np.gradient(points, axis=0)
    closed = len(points) > 2 and np.allclose(points[0], points[-1])
    if closed:
        step[0] = step[-1] = points[1] - points[-2]
    tangent = step / np.linalg.norm(step, axis=1, keepdims=True)
    bend = np.cross(tangent[0], tangent[len(points) // 2])
    if np.linalg.norm(bend) < 1e-6:  # straight: any direction across it
        bend = np.cross(tangent[0], np.eye(3)[np.argmin(np.abs(tangent[0]))])
    across = bend / np.linalg.norm(bend)
    cos, sin = _circle(sides)[:, :1], _circle(sides)[:, 1:]
    rings = [
        point + radius * (cos * np.cross(across, t) + sin * across)
        for point, radius, t in zip(points, radii, tangent, strict=True)
    ]
    return loft(rings, caps=not closed)


def bar(
    start: Points, end: Points, radius: Number, end_radius: Number | None = None, sides: int = 6
) -> Solid:
    """Return a round bar with sharp rims between the points `start` and `end`.

    The bar is a frustum of a cone if its radius at the end, `end_radius`, differs from `radius`. With at most
    6 `sides`, the edges between the sides are sharp too.
    """
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
    return loft([first + radii[0] * circle, last + radii[1] * circle], "rims" if sides > 6 else "sharp")


def wheel(center: Points, radius: Number, width: Number, sides: int = 16) -> Solid:
    """Return a disc with its axis parallel to x and its centre at `center`; `width` is its thickness."""
    middle = np.asarray(center, dtype=np.float64)
    half = np.array([width / 2, 0, 0])
    return bar(middle - half, middle + half, radius, sides=sides)


def torus(center: Points, radius: Number, thickness: Number, sides: int = 20, around: int = 5) -> Solid:
    """Return a torus whose axis is parallel to x; its faces run clockwise seen from outside.

    Args:
        center: centre of the torus.
        radius: distance from the axis to the middle of the tube.
        thickness: diameter of the tube.
        sides: number of cross-sections along the tube.
        around: number of points of a cross-section.
    """
    out, along = _circle(sides), _circle(around)
    distance = radius + thickness / 2 * along[:, 0]
    vertices = np.empty((sides, around, 3))
    vertices[..., 0] = thickness / 2 * along[:, 1]
    vertices[..., 1] = distance * out[:, :1]
    vertices[..., 2] = distance * out[:, 1:]
    return Solid(vertices.reshape(-1, 3) + np.asarray(center), _torus_faces(sides, around))


@cache
def _torus_faces(sides: int, around: int) -> Int[np.ndarray, "faces 3"]:
    quads = quad_corners(sides, around).reshape(-1, 4)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def ellipsoid(center: Points, radii: Points, sides: int = 14, layers: int = 9) -> Solid:
    """Return an ellipsoid with centre `center` and half axes `radii` along x, y, z.

    The surface runs through `layers` horizontal rings with `sides` points each; the first and the last ring shrink to
    points.
    """
    angle = np.linspace(-np.pi / 2, np.pi / 2, layers)
    unit = revolution(np.stack([np.cos(angle), np.sin(angle)], axis=1), sides, "rims")
    return unit.scale(*radii).move(*center)
