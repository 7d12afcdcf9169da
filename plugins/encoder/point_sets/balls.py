"""Points of clouds within balls about some of them, compiled at the first call; the compiled code is kept on disk."""

from pathlib import Path
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.storage.kernels import compiler, kept_in

compiled = compiler(kept_in("balls", [Path(__file__)]))


@torch.no_grad()
def within(
    places: Float[Tensor, "point 3"],
    counts: Int[Tensor, "batch"],
    centroids: int,
    radius: float,
    most: int,
) -> Int[Tensor, "centroid most"]:
    """Rows of the points that are within a radius of each centroid: the first so many of its cloud, in their order.

    The first points of each cloud are its centroids, all where it has fewer. Where fewer points are within the radius
    the first of them stands in the places left. Computed in float64 on the processor, wherever the clouds are.

    Args:
        places: of all clouds one after the other.
        counts: how many points each cloud has.
        centroids: how many of each cloud.
        radius: in units of the places; what is exactly so far away is within.
        most: how many are wanted of each ball.
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
