"""Data that one image leaves for the next: arrays to draw in, checked faces, and geometry that may be unchanged.

The same object is not taken as unchanged: the kept numbers are compared with the new numbers one by one, which costs as
much as reading them up to the first difference.
"""

from functools import cached_property
from typing import no_type_check

import numpy as np

from plugins.renderer.rasterizer import raster
from plugins.renderer.rasterizer.boundary import neighbours

BLOCK = 1024
MOST = 8
"""Largest number of meshes that are kept, and of canvases that wait for their next use."""
MOST_BYTES = 2**28
"""Largest size of all waiting canvases together, bytes."""

Box = tuple[int, int, int, int]
Tiles = tuple[np.ndarray, np.ndarray, np.ndarray]


@raster.compiled
@no_type_check
def alike(one, other):
    """Return whether two flat integer arrays of the same length are equal."""
    for start in range(0, one.shape[0], BLOCK):
        part, other_part = one[start : start + BLOCK], other[start : start + BLOCK]
        differing = np.int64(0)
        for place in range(part.shape[0]):
            differing |= part[place] ^ other_part[place]
        if differing != 0:
            return False
    return True


def bits(array: np.ndarray) -> np.ndarray:
    """Return floating-point numbers as a flat array of integers with the same bits."""
    return array.reshape(-1).view(f"i{array.itemsize}")


class Corners:
    """Rows of three indices in the form that kernels read, (faces, 3) int32, and the largest index.

    A negative index counts as larger than any array. If an index does not fit int32, the rows are meaningless.
    """

    def __init__(self, given: np.ndarray) -> None:
        self.array = given.astype(np.int32)
        self.largest = int(raster.largest_index(given.reshape(-1).view(f"u{given.itemsize}")))

    @cached_property
    def beside(self) -> np.ndarray:
        """The face beyond each edge of each face, see `neighbours`."""
        return neighbours(self.array)

    def holds(self, given: np.ndarray) -> bool:
        """Return whether these are the given rows of indices."""
        return given.shape == self.array.shape and alike(given.reshape(-1), self.array.reshape(-1))


class Shelf:
    """Meshes that were drawn recently, the latest first; threads may share it, since lists are only replaced."""

    def __init__(self) -> None:
        self._kept: list[Corners] = []

    def find(self, given: np.ndarray) -> Corners:
        """Return the checked form of rows of indices, which may refer to vertices or to texture places."""
        for kept in self._kept:
            if kept.holds(given):
                if kept is not self._kept[0]:
                    self._kept = [kept, *(other for other in self._kept if other is not kept)][:MOST]
                return kept
        new = Corners(given)
        self._kept = [new, *self._kept[: MOST - 1]]
        return new


class Canvas:
    """Arrays of one image; see `raster`.

    `depth` and `face` are clear outside of `box`; `counts` says what happened to the faces that they show.
    """

    def __init__(self) -> None:
        self.seen, self.screen = np.empty((0, 3)), np.empty((0, 5))
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
        self._drawn: tuple[Corners, bool] | None = None

    @property
    def bytes(self) -> int:
        """Size of all arrays, bytes."""
        arrays = (self.seen, self.screen, self.depth, self.face, self._vertices, *self._scratch)
        return sum(array.nbytes for array in arrays)

    def placed(self, vertices: np.ndarray, pose: np.ndarray) -> bool:
        """Return whether `seen` and `screen` hold these vertices from this pose; otherwise record that they will."""
        kept = self._vertices
        if kept.shape == vertices.shape and kept.dtype == vertices.dtype and len(self._pose) == len(pose):
            if bool((self._pose == pose).all()) and alike(bits(vertices), bits(kept)):
                return True
        else:
            self._vertices = np.empty_like(vertices)
            self.seen, self.screen = np.empty((len(vertices), 3)), np.empty((len(vertices), 5))
        self._vertices[:] = vertices
        self._pose = pose
        self._drawn = None
        return False

    def scratch(self, faces: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the working arrays of `interior`."""
        most = min(faces, self.face.size)
        if len(self._scratch[0]) != faces or len(self._scratch[2]) < most:
            self._scratch = np.full(faces, -1, np.int32), np.empty((most, 20)), np.empty(most, np.int32)
        return self._scratch

    def forget(self) -> None:
        """Forget what was drawn, so that the next image reuses nothing."""
        self._pose, self._drawn = np.empty(0), None

    def has(self, corners: Corners, cull: bool, size: tuple[int, int]) -> bool:
        """Return whether `depth` and `face` show this mesh, in the pose of the last call of `placed`."""
        return self.depth.shape == size and self._drawn == (corners, cull)

    def cleared(self, size: tuple[int, int]) -> None:
        """Make `depth`, `face`, tiles and counts ready to be drawn in."""
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
        self._drawn, self.box = None, (0, height, 0, width)  # safe if drawing fails before `shows`

    def empty_tiles(self) -> Tiles:
        """Return the tiles of cleared arrays."""
        farthest, empty, changed = self.tiles
        farthest.fill(np.inf)
        changed.fill(0)
        sides = [
            np.minimum(raster.TILE, side - raster.TILE * np.arange(count))
            for side, count in zip(self.depth.shape, empty.shape, strict=True)
        ]
        np.multiply.outer(*sides, out=empty, casting="same_kind")
        return self.tiles

    def shows(self, corners: Corners, cull: bool, box: Box, counts: np.ndarray) -> None:
        """Record which mesh `depth` and `face` show, in which box, and what happened to its faces."""
        self._drawn, self.box, self.counts = (corners, cull), box, counts


class Lease:
    """A canvas that is in use as long as an image needs it, or the gradient of that image."""

    def __init__(self, pool: list[Canvas]) -> None:
        self._pool = pool
        try:
            self.canvas = pool.pop()
        except IndexError:  # no canvas waits
            self.canvas = Canvas()

    def __del__(self) -> None:
        waiting = [*self._pool, self.canvas]
        if len(waiting) <= MOST and sum(canvas.bytes for canvas in waiting) <= MOST_BYTES:
            self._pool.append(self.canvas)
