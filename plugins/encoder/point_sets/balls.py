"""Search for the points within balls around centroids; it is compiled at the first call and kept on disk."""

from pathlib import Path
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.storage.kernels import compiler, kernel_cache

compiled = compiler(kernel_cache("balls", [Path(__file__)]))


@torch.no_grad()
def find_within(
    positions: Float[Tensor, "point 3"],
    counts: Int[Tensor, "batch"],
    centroids: int,
    radius: float,
    most: int,
) -> Int[Tensor, "centroid most"]:
    """Return for each centroid the rows of the first `most` points of its cloud that lie within a radius of it.

    The first `centroids` points of each cloud are its centroids, or all points if the cloud has fewer. If fewer than
    `most` points are within the radius, the row of the first of them is repeated. The distances are computed in float64
    on the CPU, whatever device the clouds are on.

    Args:
        positions: positions of the points of all clouds, concatenated.
        counts: number of points of each cloud.
        centroids: largest number of centroids of a cloud.
        radius: radius in units of the positions; a point at exactly this distance is within the radius.
        most: number of rows returned for each centroid.

    Returns:
        Rows of `positions`, (centroid, most), for the centroids of all clouds.
    """
    coordinates = np.ascontiguousarray(positions.detach().cpu().double().numpy())
    neighbours = _fill_neighbours(coordinates, counts.cpu().numpy(), centroids, radius * radius, most)
    return torch.from_numpy(neighbours).to(positions.device)


@compiled
@no_type_check
def _fill_neighbours(positions, counts, centroids, square, most):
    neighbours = np.empty((np.minimum(counts, centroids).sum(), most), dtype=np.int64)
    row, start = 0, 0
    for number in range(len(counts)):
        end = start + counts[number]
        for centre in range(start, min(end, start + centroids)):
            x, y, z = positions[centre, 0], positions[centre, 1], positions[centre, 2]
            filled = 0
            for point in range(start, end):
                across, along, up = positions[point, 0] - x, positions[point, 1] - y, positions[point, 2] - z
                if across * across + along * along + up * up <= square:
                    neighbours[row, filled] = point
                    filled += 1
                    if filled == most:
                        break
            neighbours[row, filled:] = neighbours[row, 0]  # the centroid itself is within the radius
            row += 1
        start = end
    return neighbours
