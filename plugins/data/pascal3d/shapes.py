"""Coloured bodies of closed solids, from which the object families are built.

Objects have the coordinates of PASCAL3D+ models: the front faces -y, z points up, and x to the left of the object.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from framework.geometry.solids import Number, Points, Solid

Array = NDArray[np.float64]
Color = tuple[float, float, float]


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
        self.add(solid.scale(-1, 1, 1).move(), color)  # adding 0 turns -0 into 0

    def rotated_copies(self, *angles: Number) -> "Body":
        """Return a body that consists of one copy of this body for each angle (radians), rotated by it about z."""
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


def offset_point(point: Points, x: Number, y: Number, z: Number) -> Array:
    """Return a point shifted by (x, y, z)."""
    return np.asarray(point) + np.array([x, y, z])
