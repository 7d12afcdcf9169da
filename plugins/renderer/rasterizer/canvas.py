"""Data that is reused from image to image: arrays to draw in, checked faces, and projected vertices.

Data counts as unchanged if all stored numbers equal the new numbers. They are compared one by one, because an array may
be changed in place. The comparison stops at the first difference.
"""

from functools import cached_property
from typing import no_type_check

import numpy as np

from plugins.renderer.rasterizer import raster
from plugins.renderer.rasterizer.boundary import find_adjacent_faces

BLOCK = 1024
MOST = 8
"""Largest number of meshes in the cache, and of unused canvases in the pool."""
MOST_BYTES = 2**28
"""Largest total size of the unused canvases, bytes."""

Box = tuple[int, int, int, int]
Tiles = tuple[np.ndarray, np.ndarray, np.ndarray]


@raster.compiled
@no_type_check
def are_equal(first, second):
    """Return whether two flat integer arrays of the same length are equal."""
    for start in range(0, first.shape[0], BLOCK):
        part, other_part = first[start : start + BLOCK], second[start : start + BLOCK]
        differing = np.int64(0)
        for index in range(part.shape[0]):
            differing |= part[index] ^ other_part[index]
        if differing != 0:
            return False
    return True


def bits(array: np.ndarray) -> np.ndarray:
    """Return a floating-point array as a flat array of integers with the same bits."""
    return array.reshape(-1).view(f"i{array.itemsize}")


class Corners:
    """Three indices per face, of vertices or of texture coordinates, in the form that compiled functions read.

    Attributes:
        array: (faces, 3) int32; meaningless if an index does not fit int32, which `largest` shows.
        largest: largest index; a negative index, read as an unsigned integer, exceeds the length of any array.
    """

    def __init__(self, indices: np.ndarray) -> None:
        self.array = indices.astype(np.int32)
        self.largest = int(indices.reshape(-1).view(f"u{indices.itemsize}").max(initial=0))

    @cached_property
    def adjacent(self) -> np.ndarray:
        """The neighbouring face at each edge of each face; see `find_adjacent_faces`."""
        return find_adjacent_faces(self.array)

    def equals(self, indices: np.ndarray) -> bool:
        """Return whether `indices` has the same shape and numbers as `array`."""
        return indices.shape == self.array.shape and are_equal(indices.reshape(-1), self.array.reshape(-1))


class MeshCache:
    """Face indices of recently drawn meshes, the latest first.

    Threads may share a cache, because its list is never changed, only replaced.
    """

    def __init__(self) -> None:
        self._meshes: list[Corners] = []

    def find(self, indices: np.ndarray) -> Corners:
        """Return the `Corners` of `indices`, (faces, 3), from the cache; if it lacks them, add them first.

        The indices refer to vertices or to texture coordinates.
        """
        for mesh in self._meshes:
            if mesh.equals(indices):
                if mesh is not self._meshes[0]:
                    self._meshes = [mesh, *(other for other in self._meshes if other is not mesh)][:MOST]
                return mesh
        new = Corners(indices)
        self._meshes = [new, *self._meshes[: MOST - 1]]
        return new


class Canvas:
    """Arrays of one image, described in `raster`.

    `depth` and `face` show the background outside of `box`. `counts` holds the number of faces with each outcome
    (`raster.rasterise`). `cut` is the number of vertices that the near plane cuts off.
    """

    def __init__(self) -> None:
        self.camera_points, self.screen = np.empty((0, 3)), np.empty((0, 5))
        self.depth, self.face = np.empty((0, 0), np.float32), np.empty((0, 0), np.int32)
        self.tiles: Tiles = (
            np.empty((0, 0), np.float32),
            np.empty((0, 0), np.int32),
            np.empty((0, 0), np.int32),
        )
        self.counts = np.zeros(0, np.int64)
        self.box: Box = (0, 0, 0, 0)
        self.cut = 0
        self._scratch = np.empty(0, np.int32), np.empty((0, 20)), np.empty(0, np.int32)
        self._vertices = np.empty((0, 3))
        self._pose = np.empty(0)
        self._shown_mesh: tuple[Corners, bool] | None = None

    @property
    def bytes(self) -> int:
        """Size of all arrays, bytes."""
        arrays = (self.camera_points, self.screen, self.depth, self.face, self._vertices, *self._scratch)
        return sum(array.nbytes for array in arrays)

    def update_pose(self, vertices: np.ndarray, pose: np.ndarray) -> bool:
        """Return whether `camera_points` and `screen` are valid for these vertices and this pose.

        If they are not valid, give them the right length, and store the vertices and the pose. The caller then fills
        both arrays.

        Args:
            vertices: Vertices in world coordinates, (vertices, 3).
            pose: All numbers of the camera on which the projection depends, as one flat array.
        """
        stored = self._vertices
        if stored.shape == vertices.shape and stored.dtype == vertices.dtype and len(self._pose) == len(pose):
            if bool((self._pose == pose).all()) and are_equal(bits(vertices), bits(stored)):
                return True
        else:
            self._vertices = np.empty_like(vertices)
            self.camera_points, self.screen = np.empty((len(vertices), 3)), np.empty((len(vertices), 5))
        self._vertices[:] = vertices
        self._pose = pose
        self._shown_mesh = None
        return False

    def scratch(self, faces: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the working arrays of `interior` for a mesh with `faces` faces."""
        most = min(faces, self.face.size)
        if len(self._scratch[0]) != faces or len(self._scratch[2]) < most:
            self._scratch = np.full(faces, -1, np.int32), np.empty((most, 20)), np.empty(most, np.int32)
        return self._scratch

    def forget(self) -> None:
        """Mark all content as outdated, so that the next image reuses nothing."""
        self._pose, self._shown_mesh = np.empty(0), None

    def shows(self, corners: Corners, cull: bool, size: tuple[int, int]) -> bool:
        """Return whether `depth` and `face` show this mesh, in the pose of the last call of `update_pose`.

        Args:
            corners: Faces of the mesh.
            cull: Whether faces seen from behind are left out.
            size: Height and width of the image.
        """
        return self.depth.shape == size and self._shown_mesh == (corners, cull)

    def clear(self, size: tuple[int, int]) -> None:
        """Set `depth` and `face` to the background, in an image of `size` (height, width)."""
        height, width = size
        if self.depth.shape != size:
            self.depth = np.full(size, np.inf, np.float32)
            self.face = np.full(size, -1, np.int32)
            tiles = -(-height // raster.TILE), -(-width // raster.TILE)
            self.tiles = np.empty(tiles, np.float32), np.empty(tiles, np.int32), np.empty(tiles, np.int32)
        else:
            top, bottom, left, right = self.box
            self.depth[top:bottom, left:right] = np.inf
            self.face[top:bottom, left:right] = -1
        self._shown_mesh, self.box = None, (0, height, 0, width)  # safe if drawing fails before `record_mesh`

    def empty_tiles(self) -> Tiles:
        """Return the arrays `farthest`, `empty` and `changed` of `raster.rasterise` for an image of only background."""
        farthest, empty, changed = self.tiles
        farthest.fill(np.inf)
        changed.fill(0)
        sides = [
            np.minimum(raster.TILE, side - raster.TILE * np.arange(count))
            for side, count in zip(self.depth.shape, empty.shape, strict=True)
        ]
        np.multiply.outer(*sides, out=empty, casting="same_kind")
        return self.tiles

    def record_mesh(self, corners: Corners, cull: bool, box: Box, counts: np.ndarray) -> None:
        """Record the mesh that `depth` and `face` show, the box of its pixels, and the counts of its faces.

        `corners` are the faces of the mesh. If `cull` is true, faces seen from behind were left out.
        """
        self._shown_mesh, self.box, self.counts = (corners, cull), box, counts


class CanvasLease:
    """A canvas in use; it returns to the pool when neither an image nor the image's gradient needs it any longer."""

    def __init__(self, pool: list[Canvas]) -> None:
        self._pool = pool
        try:
            self.canvas = pool.pop()
        except IndexError:  # the pool is empty
            self.canvas = Canvas()

    def __del__(self) -> None:
        unused = [*self._pool, self.canvas]
        if len(unused) <= MOST and sum(canvas.bytes for canvas in unused) <= MOST_BYTES:
            self._pool.append(self.canvas)
