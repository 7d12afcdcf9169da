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
def within(
    places: Float[Tensor, "point 3"],
    counts: Int[Tensor, "batch"],
    centroids: int,
    radius: float,
    most: int,
) -> Int[Tensor, "centroid most"]:
    """Return rows of the points within a radius of each centroid: the first `most` of its cloud, in their order.

    The first points of each cloud are its centroids, all of them if it has fewer. If fewer than `most` points are
    within the radius, the first of them fills the remaining places. The distances are computed in float64 on the CPU,
    whatever device the clouds are on.

    Args:
        places: positions of the points of all clouds, concatenated.
        counts: number of points of each cloud.
        centroids: number of centroids of each cloud.
        radius: in units of the positions; a point at exactly this distance is within.
        most: number of rows returned for each ball.
    """
    coordinates = np.ascontiguousarray(places.detach().cpu().double().numpy())
    found = _within(coordinates, counts.cpu().numpy(), centroids, radius * radius, most)
    return torch.from_numpy(found).to(places.device)


@compiled
@no_type_check
def _within(places, counts, centroids, square, most):
    found = np.empty((np.minimum(counts, centroids).sum(), most), dtype=np.int64)
    row, start = 0, 0
    for number in range(len(counts)):
        end = start + counts[number]
        for centre in range(start, min(end, start + centroids)):
            x, y, z = places[centre, 0], places[centre, 1], places[centre, 2]
            filled = 0
            for point in range(start, end):
                across, along, up = places[point, 0] - x, places[point, 1] - y, places[point, 2] - z
                if across * across + along * along + up * up <= square:
                    found[row, filled] = point
                    filled += 1
                    if filled == most:
                        break
            found[row, filled:] = found[row, 0]  # the centroid itself is within, so that there is a first
            row += 1
        start = end
    return found
