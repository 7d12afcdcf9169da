"""Points where no moon is; the contract is framework.data's."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.data import Batch, Data, Splits
from framework.datasets.fields import Fields
from plugins.data.moons.points import TARGET, DataSeed, Size, fingerprint, picture, read_points, split_of


class MoonsOutliers(Data):
    """Two discs in the upper left and the lower right corner of [-4, 4]², far from every moon.

    A network trained on `moons` has seen nothing there and is sure all the same (the triangles of thesis Figure 2.2;
    §2.3.1).

    Points are uniform on the discs, in the standard units of `moons`. Their targets name the moon on whose side they
    lie and mean nothing. The splits are independent draws.

    Args:
        train, validation, test: samples of each split, the discs in turn.
        corner: the discs' centres are (-corner, corner) and (corner, -corner).
        radius: of the discs.
        data_seed: of the draws, whatever the seed of the run.
    """

    bibtex = """@phdthesis{prokudin2020robust,
  title = {Robust and Efficient Deep Visual Learning},
  author = {Prokudin, Sergey},
  school = {Universit{\\"a}t T{\\"u}bingen},
  year = {2020}
}"""
    target = TARGET
    input_shape = (2,)
    groups = ("outliers",)
    synthetic = True
    skipped = 0
    varies = False

    def __init__(
        self,
        *,
        train: Size = 500,
        validation: Size = 500,
        test: Size = 1000,
        corner: Annotated[float, Field(ge=1, le=1e6, allow_inf_nan=False)] = 3.2,
        radius: Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)] = 0.6,
        data_seed: DataSeed = 0,
    ) -> None:
        self.sizes = (train, validation, test)
        self.corner = corner
        self.radius = radius
        self.data_seed = data_seed

    def prepare(self) -> None:
        self._splits = [self._drawn(size, number) for number, size in enumerate(self.sizes)]

    def _drawn(self, size: int, split: int) -> Fields:
        # 1: a stream of its own beside those of moons with the same seed
        random = np.random.default_rng([self.data_seed, split, 1, 1]).random((size, 2))
        label = np.arange(size) % 2
        centre = np.where(label == 0, 1.0, -1.0)[:, None] * [-self.corner, self.corner]
        # the square root of a uniform number is the radius of a uniform point of a disc
        distance, angle = self.radius * np.sqrt(random[:, 0]), 2 * math.pi * random[:, 1]
        points = centre + distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
        return split_of(torch.from_numpy(points).float(), label)

    def splits(self) -> Splits:
        return Splits(*self._splits)

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return read_points(files)

    def augment(self, batch: Batch) -> Batch:
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        return fingerprint(
            "moons_outliers 1",
            self._splits,
            corner=self.corner,
            radius=self.radius,
            data_seed=self.data_seed,
        )

    def picture(self, inputs: Tensor) -> np.ndarray:
        return picture(inputs, self._splits[0])
