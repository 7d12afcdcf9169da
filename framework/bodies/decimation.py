"""Decimation of closed meshes: edges are collapsed onto one of their ends until few enough vertices are left.

The edge whose collapse changes the surface least comes first. The method is quadric error metrics (Garland and Heckbert
1997) with half-edge collapses: the remaining vertices are a subset of the mesh's own, and therefore keep their colours,
texture coordinates and other attributes.
"""

import heapq
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from framework.errors import DataError

EVEN = 1e-3
"""Weight of the fourth power of an edge's length in the cost of its collapse, which keeps triangles of similar size."""
TURN = 0.2
"""Smallest allowed cosine of the angle between a triangle's normals before and after a collapse."""


class Decimated(NamedTuple):
    """Result of a decimation: the remaining vertices, and the corners of the triangles in the mesh and in the texture.

    All numbers are indices into the arrays of the mesh before decimation.

    Attributes:
        kept: the remaining vertices, ascending.
        faces: vertices of each remaining triangle.
        uv_faces: texture coordinates of each remaining triangle.
    """

    kept: Int[np.ndarray, "left"]  # this name is a key of cached files
    faces: Int[np.ndarray, "triangles 3"]
    uv_faces: Int[np.ndarray, "triangles 3"]


def decimate(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    uv_faces: Int[np.ndarray, "faces 3"],
    count: int,
) -> Decimated:
    """Collapse edges until `count` vertices are left; the edge whose collapse changes the surface least comes first.

    If several edges would change the surface equally, the one with the lowest vertex number is collapsed first.

    Seams of the texture stay seams: a vertex on a seam moves along it or not at all.

    Args:
        vertices: coordinates.
        faces: vertices of each triangle.
        uv_faces: texture coordinates of each triangle, as indices.
        count: number of vertices to keep.

    Raises:
        DataError: no edge is left that may collapse.
    """
    work = _Collapses(vertices, faces, uv_faces)
    left = len(vertices)
    while left > count:
        if not work.step():
            raise DataError(
                f"The mesh cannot be reduced to {count} vertices: {left} of {len(vertices)} vertices are left, and no "
                "edge between them can be removed. Choose a topology with more vertices."
            )
        left -= 1
    alive = [face for face in range(len(faces)) if work.corners[face] is not None]
    return Decimated(
        np.flatnonzero(work.alive),
        np.array([work.corners[face] for face in alive], np.int64),
        np.array([work.places[face] for face in alive], np.int64),
    )


class _Collapses:
    """State of the mesh during decimation.

    It consists of lists and tuples, which are faster than arrays here, because each step reads only a few numbers.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, uv_faces: np.ndarray) -> None:
        self.points = [tuple(point) for point in vertices.astype(np.float64).tolist()]
        self.corners: list[list[int] | None] = faces.tolist()
        self.places: list[list[int]] = uv_faces.tolist()
        self.alive = np.ones(len(vertices), bool)
        self.around: list[set[int]] = [set() for _ in self.points]
        for number, corners in enumerate(faces.tolist()):
            for corner in corners:
                self.around[corner].add(number)
        self.quadrics = _quadrics(vertices.astype(np.float64), faces).tolist()
        self.changed = [0] * len(self.points)
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        both = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
        self.heap = [self._entry(v, u) for v, u in both.tolist()]
        heapq.heapify(self.heap)

    def step(self) -> bool:
        """Collapse the edge of lowest cost among those that may collapse; return whether there was such an edge."""
        while self.heap:
            _, v, u, of_v, of_u = heapq.heappop(self.heap)
            if not (self.alive[v] and self.alive[u]) or (of_v, of_u) != (self.changed[v], self.changed[u]):
                continue
            moved = self._places_after(v, u)
            if moved is None or not self._keeps_shape(v, u):
                continue
            self._collapse(v, u, moved)
            return True
        return False

    def _entry(self, v: int, u: int) -> tuple[float, int, int, int, int]:
        a = [first + second for first, second in zip(self.quadrics[v], self.quadrics[u], strict=True)]
        x, y, z = self.points[u]
        error = (
            a[0] * x * x + a[4] * y * y + a[7] * z * z + a[9]
            + 2 * (a[1] * x * y + a[2] * x * z + a[3] * x + a[5] * y * z + a[6] * y + a[8] * z)
        )  # fmt: skip
        p, q, r = self.points[v]
        length = (x - p) ** 2 + (y - q) ** 2 + (z - r) ** 2
        return error + EVEN * length * length, v, u, self.changed[v], self.changed[u]

    def _neighbours(self, v: int) -> set[int]:
        return {corner for face in self.around[v] for corner in self.corners[face] or ()} - {v}

    def _places_after(self, v: int, u: int) -> dict[int, int] | None:
        """Return for each texture coordinate of vertex v the one of vertex u that replaces it if v collapses onto u.

        The result is None if the collapse would break a seam of the texture.
        """
        place_after: dict[int, int] = {}
        for face in self.around[v] & self.around[u]:
            corners, places = self.corners[face] or [], self.places[face]
            at_v, at_u = places[corners.index(v)], places[corners.index(u)]
            if place_after.setdefault(at_v, at_u) != at_u:
                return None
        needed = {self.places[face][(self.corners[face] or []).index(v)] for face in self.around[v]}
        return place_after if needed <= set(place_after) else None

    def _keeps_shape(self, v: int, u: int) -> bool:
        """Return whether vertex v may collapse onto vertex u.

        This is allowed if the mesh stays a manifold (v and u share exactly two neighbours) and no triangle
        flips (TURN bounds the rotation of its normal).
        """
        if len(self.around[v] & self.around[u]) != 2 or len(self._neighbours(v) & self._neighbours(u)) != 2:
            return False
        for face in self.around[v] - self.around[u]:
            corners = self.corners[face] or []
            before = _normal(*(self.points[corner] for corner in corners))
            after = _normal(*(self.points[u if corner == v else corner] for corner in corners))
            dot = sum(first * second for first, second in zip(before, after, strict=True))
            lengths = sum(first * first for first in before) * sum(first * first for first in after)
            if lengths == 0 or dot < TURN * lengths**0.5:
                return False
        return True

    def _collapse(self, v: int, u: int, moved: dict[int, int]) -> None:
        for face in list(self.around[v]):
            corners = self.corners[face] or []
            if u in corners:
                for corner in corners:
                    self.around[corner].discard(face)
                self.corners[face] = None
                continue
            place = corners.index(v)
            corners[place] = u
            self.places[face][place] = moved[self.places[face][place]]
            self.around[u].add(face)
        self.around[v] = set()
        self.alive[v] = False
        self.quadrics[u] = [a + b for a, b in zip(self.quadrics[v], self.quadrics[u], strict=True)]
        self.changed[u] += 1
        for other in self._neighbours(u):
            heapq.heappush(self.heap, self._entry(other, u))
            heapq.heappush(self.heap, self._entry(u, other))


def _normal(a: tuple[float, ...], b: tuple[float, ...], c: tuple[float, ...]) -> tuple[float, float, float]:
    x, y, z = (start - origin for start, origin in zip(b, a, strict=True))
    p, q, r = (start - origin for start, origin in zip(c, a, strict=True))
    return y * r - z * q, z * p - x * r, x * q - y * p


def _quadrics(vertices: np.ndarray, faces: np.ndarray) -> Float[np.ndarray, "vertices 10"]:
    """Return the quadric of each vertex: the upper triangle of a symmetric 4 × 4 matrix, row by row.

    The matrix is Σ a n nᵀ over the triangles around the vertex. a is the area of a triangle, and n its plane: the unit
    normal and the offset (Garland, eq. 2).
    """
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1, keepdims=True)
    normal = np.divide(cross, area, out=np.zeros_like(cross), where=area > 0)
    plane = np.concatenate([normal, -(normal * a).sum(1, keepdims=True)], 1)
    rows, columns = np.triu_indices(4)
    outer = area / 2 * plane[:, rows] * plane[:, columns]
    quadrics = np.zeros((len(vertices), 10))
    for corner in range(3):
        np.add.at(quadrics, faces[:, corner], outer)
    return quadrics
