"""Farthest-point order of clouds: each point is as far as possible from the points before it (Eldar et al. 1997)."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor


@torch.no_grad()
def farthest(
    positions: Float[Tensor, "batch points 3"], counts: Int[Tensor, "batch"], count: int
) -> Int[Tensor, "batch count"]:
    """Return indices of points of each cloud: each as far as possible from those before, the first from the mean.

    Of equally far points the first is chosen. No point is chosen twice before all were chosen; then the sequence
    repeats. So every order of a cloud's points gives the same positions, unless distances are equal, and a
    smaller `count` gives the beginning of the result of a larger one. The result is
    computed in float64 on the CPU, on whatever device the clouds are.

    Args:
        positions: positions of the points, (batch, points, 3).
        counts: sizes of the clouds, 1 or more; rows behind them are not read.
        count: number of points to choose.
    """
    from framework.geometry.farthest_compiled import farthest as compiled

    coordinates = np.ascontiguousarray(positions.detach().cpu().double().numpy())
    return torch.from_numpy(compiled(coordinates, counts.cpu().numpy(), count)).to(positions.device)
