"""Farthest-point order of clouds: each point is as far as possible from the points before it (Eldar et al. 1997)."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.errors import ConfigError


@torch.no_grad()
def farthest(
    positions: Float[Tensor, "batch points 3"], counts: Int[Tensor, "batch"], count: int
) -> Int[Tensor, "batch count"]:
    """Return `count` indices of points of each cloud, each as far as possible from the points chosen before it.

    The first point is the farthest from the mean of the cloud. Of equally far points, the one with the lowest index is
    chosen. No point is chosen twice before all are chosen; then the sequence repeats. The chosen positions do not
    depend on the order of the points in the cloud, unless distances are equal. A smaller `count` gives the first
    indices of a larger one. Everything is computed in float64 on the CPU, on whatever device the clouds are.

    Args:
        positions: positions of the points, (batch, points, 3).
        counts: number of points of each cloud, at least 1; later rows are not read.
        count: number of points to choose.
    """
    if torch.compiler.is_exporting():
        raise ConfigError(
            "The order of the farthest points cannot be exported, because it is found step by step, for which ONNX "
            "has no operation. For an export, train a model with another encoder."
        )
    from framework.geometry.farthest_compiled import farthest as compiled

    coordinates = np.ascontiguousarray(positions.detach().cpu().double().numpy())
    return torch.from_numpy(compiled(coordinates, counts.cpu().numpy(), count)).to(positions.device)
