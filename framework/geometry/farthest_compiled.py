"""Farthest-point sampling, compiled at its first call; the compiled code is kept on disk."""

from pathlib import Path
from typing import no_type_check

import numpy as np
from numba import njit

from framework.storage.kernels import compiler, kernel_cache

compiled = compiler(kernel_cache("farthest", [Path(__file__)]))


@compiled
@no_type_check
def farthest(clouds, counts, count):
    """Return the first `count` indices of each cloud in farthest-point order, (cloud, count).

    `framework.geometry.farthest.farthest` defines this order.

    Args:
        clouds: (cloud, point, 3) float64, C-contiguous.
        counts: number of points of each cloud, int64; later rows are not read.
        count: number of points to choose.
    """
    indices = np.empty((len(clouds), count), dtype=np.int64)
    for number in range(len(clouds)):
        cloud, size = clouds[number], counts[number]
        at = np.zeros(3)
        for axis in range(3):
            at[axis] = cloud[:size, axis].mean()
        distance = np.empty(size)
        best, farthest_point = -1.0, 0
        for point in range(size):
            square = _square(cloud, point, at)
            if square > best:
                best, farthest_point = square, point
        distance[:] = np.inf
        for step in range(count):
            if step >= size:
                indices[number, step] = indices[number, step - size]  # all were chosen: repeat them
                continue
            indices[number, step] = farthest_point
            at[:] = cloud[farthest_point]
            distance[farthest_point] = -1.0  # marks this point as chosen, not others at the same position
            best, farthest_point = -1.0, 0
            for point in range(size):
                if distance[point] >= 0:
                    square = min(distance[point], _square(cloud, point, at))
                    distance[point] = square
                    if square > best:
                        best, farthest_point = square, point
    return indices


@njit(inline="always")
@no_type_check
def _square(cloud, point, at):
    return (cloud[point, 0] - at[0]) ** 2 + (cloud[point, 1] - at[1]) ** 2 + (cloud[point, 2] - at[2]) ** 2
