"""As many points of a cloud as are wanted, the same ones at every call."""

from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

Choice = Literal["random", "farthest"]


def chosen(
    clouds: Float[Tensor, "batch points columns"],
    counts: Int[Tensor, "batch"],
    count: int,
    choice: Choice,
    seed: int,
) -> Int[Tensor, "batch count"]:
    """Which points of each cloud, as indices; those of a cloud that has fewer in turn, over and over.

    "random": drawn without replacement, by the seed and the cloud's size alone. "farthest": each as far as can be from
    all before it, the first from the mean; of equally far ones the first.

    Args:
        counts: sizes of the clouds.
    """
    if choice == "random":
        rows = [_random(size, count, seed) for size in counts.tolist()]
        return torch.stack(rows).to(clouds.device) if rows else counts.new_zeros(0, count)
    from plugins.encoder.points.farthest import farthest

    coordinates = np.ascontiguousarray(clouds[..., :3].detach().cpu().double().numpy())
    return torch.from_numpy(farthest(coordinates, counts.cpu().numpy(), count)).to(clouds.device)


@lru_cache(maxsize=4096)
def _random(size: int, count: int, seed: int) -> Int[Tensor, "count"]:
    # NumPy promises the bits of its legacy generator for good
    order = np.random.RandomState([seed, size]).permutation(size)
    return torch.from_numpy(order[np.arange(count) % size].astype(np.int64))
