"""Clipping of faces at the near plane; compiled functions on the arrays of `raster`."""

from typing import no_type_check

import numpy as np

from plugins.renderer.rasterizer.raster import FARTHEST, compiled, on_screen


@compiled
@no_type_check
def clip(camera_points, faces, focal, principal, near):
    """Return the visible parts of all faces that the near plane cuts, as triangles.

    The arguments are described in `raster`. The visible part of a face with one corner in front of the plane is one
    triangle; the visible part of a face with two such corners is divided into two triangles. A new corner on an edge is
    computed from the edge's vertices in the order of their indices, so that neighbouring faces get the same corner.

    Returns:
        Corners of the triangles, (corners, 5), as rows of `screen` (see `raster`); triangles as indices of these rows,
        (triangles, 3); index of the face that each triangle is a part of, (triangles,).
    """
    count = 0
    for index in range(faces.shape[0]):
        front = 0
        for corner in range(3):
            front += is_in_front(camera_points, faces[index, corner], near)
        all_finite = is_finite(camera_points, faces, index)
        count += front if all_finite and front < 3 else 0
    corners = np.zeros((4 * count, 5))
    parts = np.empty((count, 3), np.int64)
    numbers = np.empty(count, np.int64)
    part = corner_number = 0
    for index in range(faces.shape[0]):
        front = 0
        for corner in range(3):
            front += is_in_front(camera_points, faces[index, corner], near)
        if front == 0 or front == 3 or not is_finite(camera_points, faces, index):
            continue
        first = corner_number
        for corner in range(3):
            current, following = faces[index, corner], faces[index, (corner + 1) % 3]
            if is_in_front(camera_points, current, near):
                x, y, z = camera_points[current, 0], camera_points[current, 1], camera_points[current, 2]
                on_screen(x, y, z, focal, principal, near, corners[corner_number])
                corner_number += 1
            if is_in_front(camera_points, current, near) != is_in_front(camera_points, following, near):
                low, high = min(current, following), max(current, following)
                share = (near - camera_points[low, 2]) / (camera_points[high, 2] - camera_points[low, 2])
                x = camera_points[low, 0] + share * (camera_points[high, 0] - camera_points[low, 0])
                y = camera_points[low, 1] + share * (camera_points[high, 1] - camera_points[low, 1])
                on_screen(x, y, near, focal, principal, near, corners[corner_number])
                corner_number += 1
        for second in range(first + 1, corner_number - 1):
            parts[part, 0], parts[part, 1], parts[part, 2] = first, second, second + 1
            numbers[part] = index
            part += 1
    return corners[:corner_number], parts[:part], numbers[:part]


@compiled
@no_type_check
def is_in_front(camera_points, vertex, near):
    """Return whether a vertex is on the visible side of the near plane: whether its depth is at least `near`."""
    return camera_points[vertex, 2] >= near


@compiled
@no_type_check
def is_finite(camera_points, faces, index):
    """Return whether all coordinates of a face are small enough for their products to be finite."""
    for corner in range(3):
        for axis in range(3):
            if not abs(camera_points[faces[index, corner], axis]) <= FARTHEST:
                return False
    return True
