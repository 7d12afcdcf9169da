"""Points where no moon is; the contract is framework.data's."""

import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.data import Batch, Data
from framework.datasets.fields import Fields
from framework.target import Target
from plugins.data.moons.data import DataSeed, Size
from plugins.data.moons.points import LABELS, picture, read_points, shown


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
        self.sizes = {"train": train, "validation": validation, "test": test}
        self.corner = corner
        self.radius = radius
        self.data_seed = data_seed

    def prepare(self) -> None:
        self.target = Target("class", LABELS)
        self.input_shape = (2,)
        self.groups = ("outliers",)
        self.synthetic = True
        self.skipped = 0
        self._tables = {name: self._table(name) for name in self.sizes}

    def _table(self, split: str) -> Fields:
        size = self.sizes[split]
        # 1: a stream of its own beside those of moons with the same seed
        random = np.random.default_rng([self.data_seed, list(self.sizes).index(split), 1, 1]).random(
            (size, 2)
        )
        label = np.arange(size) % 2
        centre = np.where(label == 0, 1.0, -1.0)[:, None] * [-self.corner, self.corner]
        # the square root of a uniform number is the radius of a uniform point of a disc
        distance, angle = self.radius * np.sqrt(random[:, 0]), 2 * math.pi * random[:, 1]
        points = centre + distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
        return Fields(
            input=torch.from_numpy(points).float(),
            target=torch.from_numpy(label),
            group=torch.zeros(size, dtype=torch.int64),
            index=torch.arange(size),
        )

    def train(self) -> Dataset[Batch]:
        return self._tables["train"]

    def validation(self) -> Dataset[Batch]:
        return self._tables["validation"]

    def test(self) -> Dataset[Batch]:
        return self._tables["test"]

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return read_points(files)

    def augment(self, batch: Batch) -> Batch:
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        digest = hashlib.sha256()
        for table in self._tables.values():
            digest.update(table.fields["input"].numpy().tobytes())
        return {
            "root": "generated",
            "version": "moons_outliers 1",
            "corner": str(self.corner),
            "radius": str(self.radius),
            "data_seed": str(self.data_seed),
            **{name: str(size) for name, size in self.sizes.items()},
            "sha256": digest.hexdigest(),
        }

    def picture(self, inputs: Tensor) -> np.ndarray:
        fields = self._tables["train"].fields
        return picture(shown(inputs), fields["input"].double().numpy(), fields["target"].numpy())
