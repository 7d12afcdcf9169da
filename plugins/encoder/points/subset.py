"""The choice of a fixed number of points of a cloud; every call chooses the same points."""

from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.errors import ConfigError
from framework.geometry.farthest import farthest

Choice = Literal["random", "farthest"]


def choose_points(
    clouds: Float[Tensor, "batch points columns"],
    counts: Int[Tensor, "batch"],
    count: int,
    choice: Choice,
    seed: int,
) -> Int[Tensor, "batch count"]:
    """Return the indices of the chosen points of each cloud.

    If a cloud has fewer than `count` points, its points are repeated in the same order. "random" chooses without
    replacement; the choice depends only on the seed and the cloud's size. "farthest" chooses points that are as far as
    possible from the points chosen before (`framework.geometry.farthest`).

    Args:
        clouds: (batch, points, columns), padded with NaN.
        counts: sizes of the clouds.
        count: number of points to choose.
        choice: "random" or "farthest".
        seed: seed of "random".
    """
    if choice == "random":
        if torch.compiler.is_exporting():
            raise ConfigError(
                "A random choice of points cannot be exported, because it depends on the number of points of each "
                "cloud. For an export, train a model with another encoder."
            )
        rows = [_random(size, count, seed) for size in counts.tolist()]
        return torch.stack(rows).to(clouds.device) if rows else counts.new_zeros(0, count)
    return farthest(clouds[..., :3], counts, count)


@lru_cache(maxsize=4096)
def _random(size: int, count: int, seed: int) -> Int[Tensor, "count"]:
    # NumPy guarantees that its legacy generator always gives the same bits
    order = np.random.RandomState([seed, size]).permutation(size)
    return torch.from_numpy(order[np.arange(count) % size].astype(np.int64))
