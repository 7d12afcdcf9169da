"""Clipping of faces at the near plane; compiled functions on arrays of `raster`."""

from typing import no_type_check

import numpy as np

from plugins.renderer.rasterizer.raster import FARTHEST, compiled, on_screen


@compiled
@no_type_check
def clipped(seen, faces, focal, principal, near):
    """Return what remains of faces that the near plane cuts: corners on the screen, triangles, and the faces' numbers.

    A face with one corner in front of the plane leaves one triangle, a face with two leaves two. A corner on an edge is
    computed from the edge's vertices in the order of their indices, so that neighbouring faces get the same corner.
    """
    count = 0
    for index in range(faces.shape[0]):
        front = 0
        for corner in range(3):
            front += drawable(seen, faces[index, corner], near)
        good = finite(seen, faces, index)
        count += front if good and front < 3 else 0
    corners = np.zeros((4 * count, 5))
    parts = np.empty((count, 3), np.int64)
    numbers = np.empty(count, np.int64)
    part = corner_number = 0
    for index in range(faces.shape[0]):
        front = 0
        for corner in range(3):
            front += drawable(seen, faces[index, corner], near)
        if front == 0 or front == 3 or not finite(seen, faces, index):
            continue
        first = corner_number
        for corner in range(3):
            here, following = faces[index, corner], faces[index, (corner + 1) % 3]
            if drawable(seen, here, near):
                x, y, z = seen[here, 0], seen[here, 1], seen[here, 2]
                on_screen(x, y, z, focal, principal, near, corners[corner_number])
                corner_number += 1
            if drawable(seen, here, near) != drawable(seen, following, near):
                low, high = min(here, following), max(here, following)
                share = (near - seen[low, 2]) / (seen[high, 2] - seen[low, 2])
                x = seen[low, 0] + share * (seen[high, 0] - seen[low, 0])
                y = seen[low, 1] + share * (seen[high, 1] - seen[low, 1])
                on_screen(x, y, near, focal, principal, near, corners[corner_number])
                corner_number += 1
        for second in range(first + 1, corner_number - 1):
            parts[part, 0], parts[part, 1], parts[part, 2] = first, second, second + 1
            numbers[part] = index
            part += 1
    return corners[:corner_number], parts[:part], numbers[:part]


@compiled
@no_type_check
def drawable(seen, vertex, near):
    """Return whether a vertex is in front of the near plane."""
    return seen[vertex, 2] >= near


@compiled
@no_type_check
def finite(seen, faces, index):
    """Return whether the coordinates of a face's vertices are small enough for products of them to stay finite."""
    for corner in range(3):
        for axis in range(3):
            if not abs(seen[faces[index, corner], axis]) <= FARTHEST:
                return False
    return True
