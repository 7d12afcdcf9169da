"""Reading of meshes and point clouds from files, and sampling of points from a surface, uniformly by area."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from framework.errors import DataError, did_you_mean, shorten
from framework.geometry import mesh_files
from framework.geometry.las import las
from framework.geometry.mesh_files import COLOURS, Parsed
from framework.geometry.ply import ply
from framework.storage.names import as_bytes
from framework.storage.reading import read_bytes, translate_errors

READERS: dict[str, Callable[[bytes], Parsed]] = {
    ".off": mesh_files.off,
    ".ply": ply,
    ".stl": mesh_files.stl,
    ".obj": mesh_files.obj,
    ".npy": mesh_files.npy,
    ".npz": mesh_files.npz,
    ".xyz": mesh_files.xyz,
    ".las": las,
}
"""Parsers of the formats that can be read, by the suffix of the file's name."""


@dataclass(frozen=True)
class Mesh:
    """A mesh, or a point cloud, which is a mesh without faces.

    Attributes:
        source: origin of the mesh, for messages.
        vertices: coordinates in the file's unit, finite.
        faces: indices of the three vertices of each triangle, counter-clockwise seen from outside.
        columns: names of the attributes: "red", "green", "blue" (0…1), "normal_x" and so on, or the file's own names.
        attributes: a number for each vertex and column, as in `Parsed`; it may be NaN.
        dropped: number of vertices that were left out because a coordinate was not finite (only with `drop_non_finite`
            of `read`).
    """

    source: str
    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    columns: tuple[str, ...] = ()
    attributes: Float[np.ndarray, "vertices columns"] | None = None
    dropped: int = 0

    def attribute(self, names: Sequence[str]) -> Float[np.ndarray, "vertices names"]:
        """Return the columns of `attributes` with the names `names`.

        Raises:
            DataError: no attribute has one of the names, a value is not finite, or a colour lies outside 0…1.
        """
        missing = [name for name in names if name not in self.columns]
        if missing:
            raise DataError(
                f"{self.source} has no column {missing[0]!r}.{did_you_mean(missing[0], self.columns)} The "
                f"columns beside x, y, z are: {shorten(', '.join(self.columns)) or 'none'}. Leave the column out, or "
                "add it to the file."
            )
        if not names or self.attributes is None:
            return np.empty((len(self.vertices), 0))
        values = self.attributes[:, [self.columns.index(name) for name in names]]
        wrong = ~np.isfinite(values)
        if wrong.any():
            row, column = (int(numbers[0]) for numbers in np.nonzero(wrong))
            raise DataError(
                f"{self.source}: point {row} (from 0) has {names[column]} = {values[row, column]}; expected "
                "finite numbers. Correct the file, or leave that column out."
            )
        bounded = [number for number, name in enumerate(names) if name in COLOURS]
        colours = values[:, bounded]
        if colours.size and not (colours.min() >= 0 and colours.max() <= 1):
            raise DataError(
                f"{self.source}: the colours go from {colours.min():g} to {colours.max():g}; expected 0 to 1. Divide "
                "them, for example, by 255."
            )
        return values


def read(file: Path, *, drop_non_finite: bool = False) -> Mesh:
    """Read a mesh or cloud file; the suffix of its name, in lower or upper case, gives the format.

    Args:
        file: path of the file.
        drop_non_finite: if true, vertices with a NaN or infinite coordinate and the faces that use them are left out
            and counted in `dropped`; if false, they are an error.

    Raises:
        DataError: the file does not exist or has an unknown format, it is damaged, it has no vertices, a face names a
            missing vertex, or a coordinate is not finite. Nothing is repaired silently.
    """
    parse = READERS.get(file.suffix.lower())
    if parse is None:
        raise DataError(f"{file}: cannot be read; expected a file whose name ends in {', '.join(READERS)}.")
    missing = "expected a mesh or point cloud. Correct the path."
    with translate_errors(file, file.suffix[1:].upper(), missing=missing):
        parsed = parse(read_bytes(file))
    if not len(parsed.vertices):
        raise DataError(
            f"{file}: the file has no vertices; expected at least one. Leave the file out, or copy it again from "
            "its source."
        )
    _check_faces(file, parsed)
    mesh = Mesh(str(file), parsed.vertices, parsed.faces, parsed.columns, parsed.attributes)
    return _handle_non_finite(mesh, drop_non_finite)


def _check_faces(file: Path, parsed: Parsed) -> None:
    wrong = (parsed.faces < 0) | (parsed.faces >= len(parsed.vertices))
    if wrong.any():
        row = int(np.flatnonzero(wrong.any(1))[0])
        raise DataError(
            f"{file}: triangle {row} (from 0) has the corners {parsed.faces[row].tolist()}, but there are only "
            f"vertices 0 to {len(parsed.vertices) - 1}. Copy the file again from its source."
        )


def _handle_non_finite(mesh: Mesh, drop: bool) -> Mesh:
    good = np.asarray(np.isfinite(mesh.vertices).all(1))
    if good.all():
        return mesh
    first = int(np.flatnonzero(~good)[0])
    if not drop or not good.any():
        raise DataError(
            f"{mesh.source}: {int((~good).sum())} of {len(good)} points have a coordinate that is not finite; the "
            f"first is point {first} (from 0): {mesh.vertices[first].tolist()}. Correct the file, or leave it out."
        )
    new_index = np.cumsum(good) - 1
    faces = mesh.faces[good[mesh.faces].all(1)]
    return replace(
        mesh,
        vertices=mesh.vertices[good],
        faces=new_index[faces],
        attributes=None if mesh.attributes is None else mesh.attributes[good],
        dropped=int((~good).sum()),
    )


class Sampled(NamedTuple):
    """Points of a surface, in the mesh's unit.

    Attributes:
        points: coordinates.
        face: index of the face in which each point lies.
        weights: barycentric weights of the three corners of that face.
    """

    points: Float[np.ndarray, "points 3"]
    face: Int[np.ndarray, "points"]
    weights: Float[np.ndarray, "points 3"]


def sample(mesh: Mesh, count: int, random: np.random.Generator) -> Sampled:
    """Return `count` independent points on the surface of a mesh, uniformly distributed over its area.

    A face is drawn with probability proportional to its area, which may be zero.

    Raises:
        DataError: the mesh has no faces, or all have area zero.
    """
    _, areas = _cross(mesh)  # twice the area, in units² of the longest side
    if not areas.sum() > 0:
        raise DataError(
            f"{mesh.source}: the {len(areas)} faces have no area, but points can only be sampled from a surface with "
            "an area. Leave the mesh out, or give points instead of a mesh."
        )
    cumulative = np.cumsum(areas)
    uniform_draws = random.random((3, count))
    # `right`: a face without area has no interval; the last face with area also gets the remainder from rounding
    face = np.searchsorted(cumulative, uniform_draws[0] * cumulative[-1], side="right")
    face = np.minimum(face, np.flatnonzero(areas)[-1])
    root = np.sqrt(uniform_draws[1])  # P = (1 - √r₁) A + √r₁ (1 - r₂) B + √r₁ r₂ C (Osada et al. 2002, eq. 1)
    weights = np.stack([1 - root, root * (1 - uniform_draws[2]), root * uniform_draws[2]], 1)
    a, b, c = mesh.vertices[mesh.faces[face].T]
    return Sampled(a + weights[:, 1:2] * (b - a) + weights[:, 2:] * (c - a), face, weights)


def normals(mesh: Mesh) -> Float[np.ndarray, "faces 3"]:
    """Return unit normals of the faces, which point outwards; 0 for a face of area zero."""
    cross, length = _cross(mesh)
    return np.divide(cross, length, out=np.zeros_like(cross), where=length > 0).T


def _cross(mesh: Mesh) -> tuple[Float[np.ndarray, "3 faces"], Float[np.ndarray, "faces"]]:
    """Return the cross product of two sides of every face, (3, faces), and its length.

    The unit is the square of the largest coordinate of a side, so that no product over- or underflows.
    """
    if not len(mesh.faces):
        raise DataError(
            f"{mesh.source}: the mesh has no faces, but points can only be sampled from a surface. Use the mesh as a "
            "point cloud, or restore the faces."
        )
    a, b, c = (mesh.vertices.T.take(mesh.faces[:, corner], 1) for corner in range(3))
    with np.errstate(over="ignore"):
        first, second = b - a, c - a
    unit = float(max(abs(first.min()), first.max(), abs(second.min()), second.max()))
    if not np.isfinite(unit):
        raise DataError(
            f"{mesh.source}: the sides of the faces are too long for float64; expected below 1e300. Choose other units."
        )
    if unit > 0:
        first, second = first / unit, second / unit
    (x, y, z), (u, v, w) = first, second
    cross = np.stack([y * w - z * v, z * u - x * w, x * v - y * u])
    return cross, np.sqrt((cross * cross).sum(0))


def stream(seed: int, name: str) -> np.random.Generator:
    """Return a generator of random numbers for one file; its numbers do not depend on the files read before.

    Args:
        seed: seed of the run.
        name: name of the file, without folders.
    """
    digest = hashlib.blake2b(as_bytes(name), digest_size=8).digest()
    return np.random.default_rng([seed, int.from_bytes(digest, "little")])
