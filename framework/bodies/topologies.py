"""Meshes of one body with fewer vertices (a subset) or more vertices (with midpoints of edges).

A sheet is the body's mesh after every edge was split in the middle, once or several times; each such pass over all
edges is a stage. The vertices of every mesh are a subset of the sheet's vertices, so values at the sheet's vertices
(colours, positions) give the values of each mesh.
"""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from framework.bodies.body import Body
from framework.bodies.decimation import Decimated, decimate
from framework.errors import DataError
from framework.storage import cache as cached
from framework.storage.arrays import read_npz
from framework.storage.generated import ensure_generated
from framework.storage.reading import read_bytes, translate_errors

VERSION = 1
"""Version of the cached decimations; it is increased whenever their content changes."""
Name = Literal["7k", "14k", "27k", "110k"]
COUNTS: dict[Name, int] = {"7k": 6_890, "27k": 27_578, "110k": 110_312}
"""Number of vertices of each topology, by its name; "7k" and "27k" are in the thesis (Table 7.1).

The topology "14k" is missing here: it is the body itself, unchanged.
"""


class Corners(NamedTuple):
    """Triangles of vertices, and the same triangles of texture coordinates."""

    faces: Int[np.ndarray, "faces 3"]
    uv_faces: Int[np.ndarray, "faces 3"]


class Split(NamedTuple):
    """A mesh after edges were split in the middle.

    Attributes:
        corners: the triangles after the split.
        pairs: for each new vertex, the two vertices of the split edge.
        uv_pairs: for each new texture coordinate, the two texture coordinates of which it is the midpoint.
    """

    corners: Corners
    pairs: Int[np.ndarray, "new 2"]
    uv_pairs: Int[np.ndarray, "new_places 2"]


@dataclass(frozen=True)
class Sheet:
    """The body's mesh after all edges were split in the middle, once for each stage.

    Attributes:
        corners: triangles of the body, and then the triangles after each stage.
        pairs: for each stage, the two ends of each split edge. The midpoints of these edges, in this order, are
            appended to the vertices.
        uv_pairs: the same for edges between texture coordinates.
    """

    corners: tuple[Corners, ...]
    pairs: tuple[Int[np.ndarray, "_new 2"], ...]
    uv_pairs: tuple[Int[np.ndarray, "_new 2"], ...]

    @property
    def faces(self) -> Int[np.ndarray, "faces 3"]:
        """Return the triangles after the last stage."""
        return self.corners[-1].faces

    def interpolate(self, values: np.ndarray, stages: int | None = None) -> np.ndarray:
        """Return values at the sheet's vertices, interpolated linearly from `values` at the body's vertices.

        Args:
            values: one row for each vertex of the body.
            stages: number of times that all edges have been split; None for the final sheet.

        Returns:
            One row for each vertex of the body's mesh after `stages` splits of all edges.
        """
        return _interpolate(values, self.pairs[:stages])

    def interpolate_uv(self, uv: Float[np.ndarray, "place 2"]) -> Float[np.ndarray, "places 2"]:
        """Return the sheet's texture coordinates, interpolated from the body's texture coordinates `uv`."""
        return _interpolate(uv, self.uv_pairs)


@dataclass(frozen=True)
class Topology:
    """A mesh whose vertices are a subset of the vertices of a `Sheet`.

    Attributes:
        rows: index in the sheet of each vertex of the mesh.
        faces: triangles as indices into `rows`, corners counter-clockwise seen from outside.
        uv_rows: index in the sheet of each texture coordinate of the mesh.
        uv_faces: triangles as indices into `uv_rows`.
    """

    rows: Int[np.ndarray, "vertices"]
    faces: Int[np.ndarray, "_faces 3"]
    uv_rows: Int[np.ndarray, "places"]
    uv_faces: Int[np.ndarray, "_faces 3"]


def sheet(body: Body, stages: int = 2) -> Sheet:
    """Return the body's mesh after all edges were split in the middle, `stages` times one after the other.

    A body without texture coordinates is treated as if each vertex had one texture coordinate.
    """
    corners = [Corners(body.faces, body.faces if body.uv_faces is None else body.uv_faces)]
    places = len(body.template) if body.uv is None else len(body.uv)
    pairs, uv_pairs, count = [], [], len(body.template)
    for _ in range(stages):
        stage = split(corners[-1], count, places)
        corners.append(stage.corners)
        pairs.append(stage.pairs)
        uv_pairs.append(stage.uv_pairs)
        count, places = count + len(stage.pairs), places + len(stage.uv_pairs)
    return Sheet(tuple(corners), tuple(pairs), tuple(uv_pairs))


def topology(body: Body, surface: Sheet, name: Name) -> Topology:
    """Return the topology called `name`: the body decimated, unchanged, or with its longest edges split.

    `surface` is the sheet of the body: its mesh with all edges split. The vertices are taken from it.

    The name stands for a number of vertices (COUNTS). For "7k", a body that has fewer vertices stays unchanged. For
    "27k" edges are split once at most and for "110k" twice at most, so a small body can have fewer vertices than the
    name says.
    """
    vertices, places = len(body.template), len(body.template if body.uv is None else body.uv)
    wanted = COUNTS.get(name, vertices)
    if name == "7k":
        if vertices > wanted:
            return _compact(*_read_decimated(body, surface.corners[0], wanted))
        return _compact(np.arange(vertices), *surface.corners[0])
    stage = 1 if name == "110k" else 0
    for pairs, uv_pairs in zip(surface.pairs[:stage], surface.uv_pairs[:stage], strict=True):
        vertices, places = vertices + len(pairs), places + len(uv_pairs)
    pairs = surface.pairs[stage]
    ends = surface.interpolate(body.template.astype(np.float64), stage)[pairs]
    lengths = ((ends[:, 0] - ends[:, 1]) ** 2).sum(1)
    longest = np.argsort(-lengths, kind="stable")[: max(wanted - vertices, 0)]
    chosen = np.zeros(len(pairs), bool)
    chosen[longest] = True
    corners = split(surface.corners[stage], vertices, places, chosen, numbered_as_all=True).corners
    rows = np.concatenate([np.arange(vertices), vertices + np.flatnonzero(chosen)])
    return _compact(rows, *corners)


def recognise_topology(
    body: Body, vertices: int, faces: Int[np.ndarray, "faces 3"], source: str
) -> tuple[Sheet, Topology]:
    """Return the sheet and the topology of the body that have the vertices and triangles of a mesh.

    The sheet is the body's mesh with all edges split; the vertices of the topology are a subset of its vertices.

    Args:
        body: the body model.
        vertices: number of vertices of the mesh.
        faces: triangles of the mesh.
        source: origin of the mesh, for messages.

    Raises:
        DataError: no topology of the body has this number of vertices, or the triangles differ.
    """
    for name in ("14k", "7k", "27k", "110k"):
        # decimation takes seconds, so it is done only if the number of vertices matches
        if name == "7k" and not vertices == COUNTS["7k"] < len(body.template):
            continue
        surface = sheet(body, {"7k": 0, "110k": 2}.get(name, 1))
        mesh = topology(body, surface, name)
        if len(mesh.rows) != vertices:
            continue
        ours, theirs = (np.unique(np.sort(corners, 1), axis=0) for corners in (mesh.faces, faces))
        if np.array_equal(ours, theirs):
            return surface, mesh
        raise DataError(
            f"{source}: the mesh has as many vertices as {body.source} ({vertices}) but different triangles, so its "
            "vertices are probably in a different order. Use a mesh that is registered to that body, or give the "
            "file of this mesh's body as --body."
        )
    raise DataError(
        f"{source}: the mesh has {vertices} vertices, but the meshes of {body.source} have {len(body.template)} "
        f"vertices, or {', '.join(map(str, COUNTS.values()))} when they are decimated or split. Set the body to "
        "which this mesh is registered."
    )


def body_in_topology(body: Body, surface: Sheet, mesh: Topology) -> Body:
    """Return a body model whose vertices are those of the topology `mesh`; it has no texture coordinates.

    `surface` is the sheet from which the topology was taken: the mesh of `body` with all edges split. A vertex of the
    body keeps its template position, its displacements by shape and its skinning weights. For a new vertex, at the
    midpoint of an edge, each of these is the mean over both ends of the edge. Where the pose bends the surface, the
    skinned midpoint is therefore not exactly the middle of the posed edge.
    """
    parts = {
        part: surface.interpolate(getattr(body, part))[mesh.rows]
        for part in ("template", "weights", "shapes", "pose_shapes")
        if getattr(body, part) is not None
    }
    return replace(body, faces=mesh.faces, uv=None, uv_faces=None, **parts)


def split(
    corners: Corners,
    vertices: int,
    places: int,
    chosen: Bool[np.ndarray, "edge"] | None = None,
    *,
    numbered_as_all: bool = False,
) -> Split:
    """Split edges in the middle: all edges, or those where `chosen` is true.

    Args:
        corners: the triangles.
        vertices: number of existing vertices; new vertices are numbered from this number on.
        places: number of existing texture coordinates; new ones are numbered from this number on.
        chosen: true for each edge to split, in the order of the function `edges`; None for all edges.
        numbered_as_all: if true, edges that are not split also take a number, which stays unused.
    """
    pairs, sides = edges(corners.faces)
    uv_pairs, uv_sides = edges(corners.uv_faces)
    marked = np.ones(len(pairs), bool) if chosen is None else chosen
    uv_marked = np.zeros(len(uv_pairs), bool)
    uv_marked[uv_sides[marked[sides]]] = True
    parts = []
    for faces, first, numbers, which in (
        (corners.faces, vertices, sides, marked),
        (corners.uv_faces, places, uv_sides, uv_marked),
    ):
        middle = first + (np.arange(len(which)) if numbered_as_all else np.cumsum(which) - 1)
        parts.append(_triangles(faces, middle[numbers], marked[sides]))
    return Split(Corners(*parts), pairs[marked], uv_pairs[uv_marked])


def edges(faces: Int[np.ndarray, "faces 3"]) -> tuple[Int[np.ndarray, "edge 2"], Int[np.ndarray, "faces 3"]]:
    """Return all edges, and for each triangle the indices of its three sides in the list of edges.

    An edge is the pair of its ends, the lower vertex number first; edges are in ascending order. The first side of a
    triangle leads from its first to its second corner.
    """
    sides = np.sort(np.stack([faces, np.roll(faces, -1, 1)], -1), -1).reshape(-1, 2)
    keys = sides[:, 0] * (faces.max(initial=0) + 1) + sides[:, 1]
    _, first, numbers = np.unique(keys, return_index=True, return_inverse=True)
    return sides[first], numbers.reshape(-1, 3)


def _triangles(faces: np.ndarray, middle: np.ndarray, marked: np.ndarray) -> Int[np.ndarray, "triangles 3"]:
    """Return the triangles after the sides where `marked` is true are split.

    `middle` holds the number of the midpoint of each side; both arrays are (triangle, side).
    """
    count = marked.sum(1)
    # corners are rotated so that a single marked side is the first, and of two marked sides neither is the last
    shift = np.where(count == 1, marked.argmax(1), np.where(count == 2, (~marked).argmax(1) + 1, 0)) % 3
    order = (np.arange(3) + shift[:, None]) % 3
    a, b, c = np.take_along_axis(faces, order, 1).T
    m, n, o = np.take_along_axis(middle, order, 1).T
    patterns = {
        0: [(a, b, c)],
        1: [(a, m, c), (m, b, c)],
        2: [(m, b, n), (a, m, n), (a, n, c)],
        3: [(a, m, o), (m, b, n), (o, n, c), (m, n, o)],
    }
    triangles_by_pattern = [
        np.stack([corner[count == number] for corner in triangle], 1)
        for number, triangles in patterns.items()
        for triangle in triangles
    ]
    return np.concatenate(triangles_by_pattern)


def _interpolate(values: np.ndarray, stages: tuple[np.ndarray, ...]) -> np.ndarray:
    for pairs in stages:
        values = np.concatenate([values, (values[pairs[:, 0]] + values[pairs[:, 1]]) / 2])
    return values


def _compact(rows: np.ndarray, faces: np.ndarray, uv_faces: np.ndarray) -> Topology:
    """Return the topology with given vertices and triangles, without texture coordinates that no triangle uses.

    Args:
        rows: the vertices, as indices of vertices of the sheet.
        faces: the triangles, as indices of vertices of the sheet.
        uv_faces: the same triangles, as indices of texture coordinates of the sheet.
    """
    place = np.zeros(max(faces.max(initial=0), rows.max(initial=0)) + 1, np.int64)
    place[rows] = np.arange(len(rows))
    uv_rows, uv_numbers = np.unique(uv_faces, return_inverse=True)
    return Topology(rows, place[faces], uv_rows, uv_numbers.reshape(-1, 3))


def _read_decimated(body: Body, corners: Corners, count: int) -> Decimated:
    """Return the body decimated to `count` vertices; the cache keeps it, because decimation takes some seconds."""
    digest = hashlib.sha256(np.ascontiguousarray(body.template).tobytes())
    for part in corners:
        digest.update(np.ascontiguousarray(part).tobytes())
    mark = {"decimated": digest.hexdigest(), "vertices": count, "version": VERSION}
    root = cached.folder("body") / f"decimated-{digest.hexdigest()[:12]}-{count}-{VERSION}"

    def write(folder: Path) -> None:
        np.savez(folder / "mesh.npz", **decimate(body.template, *corners, count)._asdict())

    ensure_generated(root, mark, write)
    with translate_errors(root / "mesh.npz", "a decimated body", f"Delete {root}: it is generated again."):
        return Decimated(**read_npz(read_bytes(root / "mesh.npz"), Decimated._fields))
