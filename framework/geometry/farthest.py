"""Orders the points of clouds so that each is as far as can be from those before it (Eldar et al. 1997)."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor


@torch.no_grad()
def farthest(
    places: Float[Tensor, "batch points 3"], counts: Int[Tensor, "batch"], count: int
) -> Int[Tensor, "batch count"]:
    """Indices of points of each cloud: each as far as can be from all before it, the first from the mean.

    Of equally far points the first, and none twice before all were chosen; then the same ones in turn. So every order
    of a cloud's points gives the same places but where distances are equal, and what is asked for less is the
    beginning of what is asked for more. Computed in float64 on the processor, wherever the clouds are.

    Args:
        counts: sizes of the clouds, 1 or more; rows behind them are not read.
        count: how many are wanted.
    """
    from framework.geometry.farthest_compiled import farthest as compiled

    coordinates = np.ascontiguousarray(places.detach().cpu().double().numpy())
    return torch.from_numpy(compiled(coordinates, counts.cpu().numpy(), count)).to(places.device)
