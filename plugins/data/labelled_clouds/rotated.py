"""Data set that repeats clouds, rotated about the up axis."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from framework.datasets.fields import FetchedInBatches
from framework.geometry.rotation import about_z
from plugins.data.labelled_clouds.reading import Clouds


class Rotated(FetchedInBatches):
    """Data set with `rotations` copies of each cloud, rotated about the up axis by multiples of 2π/`rotations`.

    The first samples are all unrotated clouds; then follow all clouds rotated by 2π/`rotations`, and so on. Normals,
    which are the fourth to sixth column if a cloud has them, rotate with their points.
    """

    def __init__(self, clouds: Clouds, rotations: int) -> None:
        self.clouds = clouds
        angle = torch.arange(rotations, dtype=torch.float64) * (2 * math.pi / rotations)
        self.matrices = about_z(angle).float()

    def __len__(self) -> int:
        return len(self.matrices) * len(self.clouds)

    def __getitems__(self, indices: Sequence[int]) -> dict[str, Tensor]:
        index = torch.as_tensor(indices)
        if ((index < 0) | (index >= len(self))).any():
            raise IndexError(
                f"Got indices from {int(index.min())} to {int(index.max())}; expected 0 to {len(self) - 1}."
            )
        batch = self.clouds.__getitems__((index % len(self.clouds)).tolist())
        matrix = self.matrices[index // len(self.clouds)]
        return {**batch, "input": _rotate(batch["input"], matrix), "index": index}


def _rotate(
    clouds: Float[Tensor, "batch points columns"], matrix: Float[Tensor, "batch 3 3"]
) -> Float[Tensor, "batch points columns"]:
    """Return the clouds with every group of three columns rotated as a vector."""
    vectors = clouds.unflatten(-1, (-1, 3))
    return torch.einsum("bij,bpvj->bpvi", matrix, vectors).flatten(-2)
