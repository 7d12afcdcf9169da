"""Closed solids as vertices and triangles, z up, from which the generated objects are made."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

Number = float | int
Point = Sequence[Number]


class Solid(NamedTuple):
    """One or several closed surfaces, as triangles."""

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]

    def move(self, x: Number = 0.0, y: Number = 0.0, z: Number = 0.0) -> "Solid":
        """Return the solid shifted along each axis."""
        return Solid(self.vertices + np.array([x, y, z]), self.faces)

    def scale(self, x: Number, y: Number, z: Number) -> "Solid":
        """Return the solid scaled along each axis."""
        return Solid(self.vertices * [x, y, z], self.faces)

    def rotate(self, axis: str, angle_deg: Number) -> "Solid":
        """Return the solid rotated about a coordinate axis, counter-clockwise seen from its positive end."""
        c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
        i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
        vertices = self.vertices.copy()
        vertices[:, i] = c * self.vertices[:, i] - s * self.vertices[:, j]
        vertices[:, j] = s * self.vertices[:, i] + c * self.vertices[:, j]
        return Solid(vertices, self.faces)


def join(solids: Sequence[Solid]) -> Solid:
    """Return all solids as one solid."""
    first = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
    return Solid(
        np.concatenate([solid.vertices for solid in solids]),
        np.concatenate([solid.faces + start for solid, start in zip(solids, first, strict=False)]),
    )


def with_mirror(solid: Solid, axis: int) -> Solid:
    """Return the solid together with its mirror image; with `axis` 0 the mirror is the plane x = 0."""
    sign = np.ones(3)
    sign[axis] = -1
    return join([solid, Solid(solid.vertices * sign, solid.faces[:, ::-1])])


def box(width: Number, depth: Number, height: Number, at: Point = (0, 0, 0)) -> Solid:
    """Return a box with width along x and depth along y; `at` is the middle of its bottom."""
    return frustum(width, depth, width, depth, height, at)


def frustum(
    width: Number, depth: Number, top_width: Number, top_depth: Number, height: Number, at: Point = (0, 0, 0)
) -> Solid:
    """Return a box whose top and bottom differ in size (a frustum of a pyramid); `at` is the middle of its bottom."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
    bottom = np.column_stack([corners * [width, depth], np.zeros(4)])
    top = np.column_stack([corners * [top_width, top_depth], np.full(4, height)])
    vertices, faces = _rings([bottom, top], 4)
    return Solid(vertices + np.asarray(at, float), faces)


def slab(outline: Sequence[Point], thickness: Number) -> Solid:
    """Return a flat plate centred in the plane z = 0; its outline (x, y) must be convex and counter-clockwise."""
    flat = np.array([(x, y, 0.0) for x, y in outline])
    half = np.array([0, 0, thickness / 2])
    return Solid(*_rings([flat - half, flat + half], len(flat)))


def revolution(profile: Sequence[Point], sides: int = 24) -> Solid:
    """Return the closed surface of revolution about z of a profile (radius, height), which runs from bottom to top."""
    angle = 2 * math.pi * np.arange(sides) / sides
    rings = [
        np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(sides, float(z))]) for r, z in profile
    ]
    return Solid(*_rings(rings, sides))


def cylinder(
    radius: Number, height: Number, at: Point = (0, 0, 0), top: Number | None = None, sides: int = 16
) -> Solid:
    """Return an upright cylinder, or a frustum with the upper radius `top`; `at` is the middle of its bottom."""
    return revolution([(radius, 0), (radius if top is None else top, height)], sides).move(*at)


def rod(start: Point, end: Point, radius: Number, sides: int = 8) -> Solid:
    """Return a round bar between two points."""
    return tube([start, end], [radius, radius], sides)


def ball(radius: Number, at: Point = (0, 0, 0), sides: int = 16) -> Solid:
    """Return a sphere with its centre at `at`."""
    bend = np.linspace(-math.pi / 2, math.pi / 2, sides // 2 + 1)
    return revolution([(radius * math.cos(b), radius * math.sin(b)) for b in bend], sides).move(*at)


def ring(radius: Number, thickness: Number, at: Point = (0, 0, 0), sides: int = 24) -> Solid:
    """Return a horizontal torus about `at`; `thickness` is the radius of its tube."""
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
    angle = 2 * math.pi * np.arange(sides) / sides
    rings = [
        point + radius * (np.cos(angle)[:, None] * np.cross(across, t) + np.sin(angle)[:, None] * across)
        for point, radius, t in zip(points, radii, tangent, strict=True)
    ]
    return Solid(*_rings(rings, sides, caps=not closed))


def prism(outline: Float[np.ndarray, "corners 2"], height: Number) -> Solid:
    """Return a prism from z = 0 to `height`; its outline must be counter-clockwise and star-shaped about the origin."""
    middle = np.zeros_like(outline)
    levels = [(middle, 0), (outline, 0), (outline, height), (middle, height)]
    rings = [np.column_stack([flat, np.full(len(flat), float(z))]) for flat, z in levels]
    return Solid(*_rings(rings, len(outline), caps=False))


def side_prism(outline: Sequence[Point], width: Number) -> Solid:
    """Return a prism along x, centred at x = 0.

    Its outline (y, z) must be counter-clockwise and star-shaped about the mean of its corners.
    """
    flat = np.asarray(outline, float)
    middle = flat.mean(0)
    solid = prism(flat - middle, width)
    return Solid(solid.vertices[:, [2, 0, 1]] + [-width / 2, *middle], solid.faces)


def tray(
    width: Number,
    depth: Number,
    height: Number,
    wall: Number,
    floor: Number,
    at: Point = (0, 0, 0),
    foot: Number = 1.0,
) -> Solid:
    """Return an open box with walls and a floor of these thicknesses.

    `foot` is the size of the bottom as a share of the size of the rim; `at` is the middle of the bottom.
    """
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
    outer = np.array([width, depth])
    inner = outer - 2 * wall
    levels = [(foot * outer, 0), (outer, height), (inner, height), (foot * inner, floor)]
    rings = [np.column_stack([corners * size, np.full(4, float(z))]) for size, z in levels]
    vertices, faces = _rings(rings, 4)
    return Solid(vertices + np.asarray(at, float), faces)


def ribbon(
    low: Float[np.ndarray, "points 2"], high: Float[np.ndarray, "points 2"], thickness: Number, height: Number
) -> Solid:
    """Return an upright sheet between two lines (x, y): `low` at z = 0 and `high` at z = `height`.

    Both lines have the same number of points, with rising x.
    """
    rings = [
        np.array(
            [
                (bottom[0], bottom[1] - thickness / 2, 0.0),
                (bottom[0], bottom[1] + thickness / 2, 0.0),
                (top[0], top[1] + thickness / 2, height),
                (top[0], top[1] - thickness / 2, height),
            ]
        )
        for bottom, top in zip(low, high, strict=True)
    ]
    return Solid(*_rings(rings, 4))


def drop_degenerate(solid: Solid) -> Solid:
    """Return the solid without triangles of which two corners coincide, as they do on a ring of radius 0."""
    corners = solid.vertices[solid.faces]
    edge_lengths = np.abs(corners - np.roll(corners, 1, axis=1)).max(-1)
    # 1e-9 instead of 0, because the computed cosine of a right angle is 6e-17
    return Solid(solid.vertices, solid.faces[(edge_lengths > 1e-9).all(1)])


def _rings(rings: Sequence[np.ndarray], sides: int, caps: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and faces of a surface through rings of `sides` points each.

    Strips of triangles join neighbouring rings. With `caps`, fans close the first and the last ring, which must then be
    convex.
    """
    vertices = np.concatenate(rings)
    corner = np.arange(sides)
    after = (corner + 1) % sides
    strips = []
    for start in range(0, (len(rings) - 1) * sides, sides):
        a, b, c, d = start + corner, start + after, start + sides + after, start + sides + corner
        strips += [np.column_stack([a, b, c]), np.column_stack([a, c, d])]
    if caps:
        inner = np.arange(1, sides - 1)
        zero = np.zeros_like(inner)
        last = (len(rings) - 1) * sides
        strips += [
            np.column_stack([zero, inner + 1, inner]),
            last + np.column_stack([zero, inner, inner + 1]),
        ]
    return vertices, np.concatenate(strips)
