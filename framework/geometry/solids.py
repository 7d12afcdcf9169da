"""Closed solids as vertices and triangles, z up: how they are moved and joined, and solids with flat sides.

Round solids are in `round_solids`.
"""

import math
from collections.abc import Sequence
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

Number = float | int
Point = Sequence[Number]
Points = Sequence[Any] | np.ndarray
"""Point (3,), or a list of points (points, 3), or a list of such lists."""
Edges = Literal["shared", "rims", "sharp"]
"""Edges of a `loft` at which the shading has a crease.

"shared": none, since facets share their vertices; "rims": the rims of the caps; "sharp": all.
"""

_SQUARE = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2


class Solid(NamedTuple):
    """One or several closed surfaces, as triangles; facets that share vertices are shaded smoothly.

    Attributes:
        vertices: coordinates.
        faces: indices of the three vertices of each triangle. Seen from outside, the triangles of one closed surface
            are all counter-clockwise or all clockwise.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]

    def move(self, x: Number = 0.0, y: Number = 0.0, z: Number = 0.0) -> "Solid":
        """Return the solid shifted along each axis."""
        return Solid(self.vertices + np.array([x, y, z]), self.faces)

    def scale(self, x: Number, y: Number, z: Number) -> "Solid":
        """Return the solid scaled along each axis."""
        return Solid(self.vertices * [x, y, z], self.faces)

    def rotate(self, axis: str, angle_deg: Number) -> "Solid":
        """Return the solid rotated about the axis "x", "y" or "z", counter-clockwise seen from its positive end."""
        c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
        i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
        vertices = self.vertices.copy()
        vertices[:, i] = c * self.vertices[:, i] - s * self.vertices[:, j]
        vertices[:, j] = s * self.vertices[:, i] + c * self.vertices[:, j]
        return Solid(vertices, self.faces)


def join(solids: Sequence[Solid]) -> Solid:
    """Return several solids as one solid."""
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


def drop_degenerate(solid: Solid) -> Solid:
    """Return the solid without triangles in which two corners coincide, as on a ring of radius 0."""
    corners = solid.vertices[solid.faces]
    edge_lengths = np.abs(corners - np.roll(corners, 1, axis=1)).max(-1)
    # 1e-9 instead of 0, because the computed cosine of a right angle is 6e-17
    return Solid(solid.vertices, solid.faces[(edge_lengths > 1e-9).all(1)])


def loft(rings: Points, edges: Edges = "shared", caps: bool = True) -> Solid:
    """Return the surface through a stack of rings, which may shrink to points.

    Args:
        rings: (rings, points, 3).
        edges: choice of the edges that are creases (`Edges`).
        caps: if true, fans of triangles close the first and the last ring, which must then be convex. If false, `edges`
            must be "shared".
    """
    stack = np.asarray(rings, dtype=np.float64)
    layers, points, _ = stack.shape
    faces = _loft_faces(layers, points, edges, caps)
    if edges == "shared":
        return Solid(stack.reshape(-1, 3), faces)
    side = stack
    if edges == "sharp":
        side = stack.reshape(-1, 3)[quad_corners(layers, points)[:-1]]
    return Solid(np.concatenate([side.reshape(-1, 3), stack[0], stack[-1]]), faces)


@cache
def _loft_faces(layers: int, points: int, edges: Edges, caps: bool) -> Int[np.ndarray, "faces 3"]:
    quads = quad_corners(layers, points)[:-1]
    if edges == "sharp":
        quads = np.arange(quads.size).reshape(quads.shape)
    halves = quads[..., [[0, 1, 2], [0, 2, 3]]]  # (layers - 1, points, 2, 3)
    inner = np.arange(1, points - 1)
    fan = np.stack([np.zeros_like(inner), inner, inner + 1], axis=1)
    # The order of the faces is part of the bytes of the generated data sets.
    if edges == "shared":
        side, low = halves.transpose(0, 2, 1, 3), fan[:, [0, 2, 1]]
        high = fan + (layers - 1) * points
    else:
        side, low = halves.transpose(2, 0, 1, 3), fan[:, ::-1] + quads.max() + 1
        high = fan + quads.max() + 1 + points
    return np.concatenate([side.reshape(-1, 3), *([low, high] if caps else [])])


@cache
def quad_corners(layers: int, points: int) -> Int[np.ndarray, "layers points 4"]:
    """Return the vertex indices of the quads between each ring and the next one; after the last ring comes the first.

    Args:
        layers: number of rings.
        points: number of points of a ring.
    """
    layer, point = np.meshgrid(np.arange(layers), np.arange(points), indexing="ij")
    above, after = (layer + 1) % layers, (point + 1) % points
    corners = [layer * points + point, layer * points + after, above * points + after, above * points + point]
    return np.stack(corners, axis=-1)


def _levels(levels: Sequence[tuple[np.ndarray, Number]], caps: bool = True) -> Solid:
    """Return the loft through horizontal outlines.

    Args:
        levels: (outline (points, 2), height) of each ring.
        caps: if true, fans of triangles close the first and the last ring.
    """
    return loft([np.insert(outline, 2, z, axis=1) for outline, z in levels], caps=caps)


def box(width: Number, depth: Number, height: Number, at: Point = (0, 0, 0)) -> Solid:
    """Return a box with its width along x and its depth along y; `at` is the middle of its bottom."""
    return frustum(width, depth, width, depth, height, at)


def block(size: Points, center: Points) -> Solid:
    """Return a box of size (width in x, depth in y, height in z) with sharp edges; `center` is its middle."""
    return _unit_block().scale(*size).move(*center)


@cache
def _unit_block() -> Solid:
    return loft([np.insert(_SQUARE, 2, height, axis=1) for height in (-0.5, 0.5)], "sharp")


def frustum(
    width: Number, depth: Number, top_width: Number, top_depth: Number, height: Number, at: Point = (0, 0, 0)
) -> Solid:
    """Return a box whose top and bottom differ in size (a frustum of a pyramid).

    Args:
        width: size of the bottom along x.
        depth: size of the bottom along y.
        top_width: size of the top along x.
        top_depth: size of the top along y.
        height: distance between bottom and top.
        at: middle of the bottom.
    """
    return _levels([(_SQUARE * [width, depth], 0), (_SQUARE * [top_width, top_depth], height)]).move(*at)


def plate(outline: Points, offset: Points, edges: Edges = "sharp") -> Solid:
    """Return a plate between two copies of a convex plane outline (points, 3), moved by ±`offset` / 2."""
    points, half = np.asarray(outline, dtype=np.float64), np.asarray(offset, dtype=np.float64) / 2
    return loft([points - half, points + half], edges)


def side_plate(outline: Sequence[Point], x: Number, thickness: Number) -> Solid:
    """Return a plate with sharp edges in the plane x = `x`; its outline (y, z) must be convex."""
    return plate([(x, y, z) for y, z in outline], (thickness, 0, 0))


def slab(outline: Sequence[Point], thickness: Number) -> Solid:
    """Return a flat plate centred in the plane z = 0; its outline (x, y) must be convex and counter-clockwise."""
    return plate([(x, y, 0.0) for x, y in outline], (0, 0, thickness), "shared")


def prism(outline: Float[np.ndarray, "corners 2"], height: Number) -> Solid:
    """Return a prism from z = 0 to `height`; its outline must be counter-clockwise and star-shaped about the origin."""
    middle = np.zeros_like(outline)
    return _levels([(middle, 0), (outline, 0), (outline, height), (middle, height)], caps=False)


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
    """Return an open box.

    Args:
        width: size of the rim along x.
        depth: size of the rim along y.
        height: distance between bottom and rim.
        wall: thickness of the walls.
        floor: thickness of the floor.
        at: middle of the bottom.
        foot: size of the bottom as a share of the size of the rim.
    """
    outer = np.array([width, depth])
    inner = outer - 2 * wall
    levels = [(foot * outer, 0), (outer, height), (inner, height), (foot * inner, floor)]
    return _levels([(_SQUARE * size, z) for size, z in levels]).move(*at)


def ribbon(
    low: Float[np.ndarray, "points 2"], high: Float[np.ndarray, "points 2"], thickness: Number, height: Number
) -> Solid:
    """Return an upright sheet between two lines (x, y): `low` at z = 0 and `high` at z = `height`.

    Both lines have the same number of points, ordered by increasing x. `thickness` is measured along y.
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
    return loft(rings)


def loft_rectangles(levels: Sequence[Point], middle: Number = 0.0) -> Solid:
    """Return the solid with sharp edges through a stack of horizontal rectangles.

    Args:
        levels: (half width, front y, rear y, z) of each rectangle.
        middle: x of the middle of all rectangles.
    """
    rings = [
        [(middle + half, near, z), (middle + half, far, z), (middle - half, far, z), (middle - half, near, z)]
        for half, near, far, z in levels
    ]
    return loft(rings, "sharp")


def bevelled(
    width: Number, low: Number, high: Number, y: Number, bevel: Number = 0.25
) -> Float[np.ndarray, "8 3"]:
    """Return a ring (8, 3) in the plane of constant `y`: a rectangle, centred at x = 0, with cut corners.

    Args:
        width: size along x.
        low: lowest z.
        high: highest z.
        y: y of all points.
        bevel: size of a cut along each side, as a share of the shorter half side.
    """
    half, middle, tall = width / 2, (low + high) / 2, (high - low) / 2
    cut = bevel * min(half, tall)
    plan = [
        (half - cut, -tall), (half, -tall + cut), (half, tall - cut), (half - cut, tall),
        (-half + cut, tall), (-half, tall - cut), (-half, -tall + cut), (-half + cut, -tall),
    ]  # fmt: skip
    return np.array([(x, y, middle + z) for x, z in plan])
