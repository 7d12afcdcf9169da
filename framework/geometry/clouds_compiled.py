"""Normalisation of clouds to the unit ball in one pass of compiled code, for small batches on the CPU."""

from pathlib import Path
from typing import no_type_check

import numpy as np

from framework.storage.kernels import compiler, kernel_cache

compiled = compiler(kernel_cache("unit_ball", [Path(__file__)]))


@compiled
@no_type_check
def unit_ball(clouds, counts, normalised, centre, scale):
    """Fill `normalised` with clouds that are normalised to the unit ball (thesis eq. 6.2).

    The mean of the points is subtracted, and then the coordinates are divided by the largest norm.

    Args:
        clouds: (cloud, point, column) float32 or float64.
        counts: number of points of each cloud, int64.
        normalised: filled with the normalised clouds; shape and dtype of `clouds`.
        centre: filled with the centre of each cloud, (cloud, 3) float64.
        scale: filled with the scale of each cloud, (cloud,) float64.
    """
    for number in range(clouds.shape[0]):
        cloud, out, count = clouds[number], normalised[number], counts[number]
        # relative to the first point: clouds far from the origin keep their digits, equal points are exactly equal
        x, y, z = np.float64(cloud[0, 0]), np.float64(cloud[0, 1]), np.float64(cloud[0, 2])
        mean_x = mean_y = mean_z = 0.0
        for point in range(count):
            mean_x += cloud[point, 0] - x
            mean_y += cloud[point, 1] - y
            mean_z += cloud[point, 2] - z
        mean_x, mean_y, mean_z = mean_x / count, mean_y / count, mean_z / count
        largest = 0.0
        for point in range(count):
            square = (
                ((cloud[point, 0] - x) - mean_x) ** 2
                + ((cloud[point, 1] - y) - mean_y) ** 2
                + ((cloud[point, 2] - z) - mean_z) ** 2
            )
            if square > largest:
                largest = square
        length = np.sqrt(largest)
        if length == 0:
            length = 1.0
        if cloud.shape[1] == 3:  # the same numbers; the compiler makes vectors of them if the stride is known
            numbers, results = cloud.reshape(-1), out.reshape(-1)
            for point in range(count):
                results[3 * point] = ((numbers[3 * point] - x) - mean_x) / length
                results[3 * point + 1] = ((numbers[3 * point + 1] - y) - mean_y) / length
                results[3 * point + 2] = ((numbers[3 * point + 2] - z) - mean_z) / length
        else:
            for point in range(count):
                out[point, 0] = ((cloud[point, 0] - x) - mean_x) / length
                out[point, 1] = ((cloud[point, 1] - y) - mean_y) / length
                out[point, 2] = ((cloud[point, 2] - z) - mean_z) / length
        for point in range(count, cloud.shape[0]):
            out[point, :3] = np.nan
        for column in range(3, cloud.shape[1]):
            for point in range(cloud.shape[0]):
                out[point, column] = cloud[point, column]
        centre[number, 0], centre[number, 1], centre[number, 2] = x + mean_x, y + mean_y, z + mean_z
        scale[number] = length
