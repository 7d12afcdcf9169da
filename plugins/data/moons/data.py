"""The two moons with overlapping noise; the contract is framework.data's."""

import hashlib
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
from plugins.data.moons.generator import draw, posterior
from plugins.data.moons.points import LABELS, picture, read_points, shown

Size = Annotated[int, Field(ge=1, le=10_000_000)]
Noise = Annotated[float, Field(ge=0.01, le=1, allow_inf_nan=False)]
DataSeed = Annotated[int, Field(ge=0, lt=2**31)]


class Moons(Data):
    """Two interleaved half circles whose noise makes the classes overlap (thesis Figure 2.2, §2.3.1).

    The classes are equally likely, and each batch holds the exact "posterior" of its points, (batch, 2): nothing can
    predict better. The splits are independent draws that depend on `data_seed` alone.

    Args:
        train, validation, test: samples of each split.
        noise: standard deviation of both coordinates, in radii of the half circles.
        data_seed: of the draws, whatever the seed of the run.
    """

    bibtex = """@article{pedregosa2011scikit,
  title = {Scikit-learn: Machine Learning in {Python}},
  author = {Pedregosa, Fabian and Varoquaux, Ga{\\"e}l and Gramfort, Alexandre and others},
  journal = {Journal of Machine Learning Research},
  volume = {12},
  pages = {2825--2830},
  year = {2011}
}"""

    def __init__(
        self,
        *,
        train: Size = 500,
        validation: Size = 500,
        test: Size = 5000,
        noise: Noise = 0.37,
        data_seed: DataSeed = 0,
    ) -> None:
        self.sizes = {"train": train, "validation": validation, "test": test}
        self.noise = noise
        self.data_seed = data_seed

    def prepare(self) -> None:
        self.target = Target("class", LABELS)
        self.input_shape = (2,)
        self.plane = True
        self.groups = ("moons",)
        self.synthetic = True
        self.skipped = 0
        self._tables = {name: self._table(name) for name in self.sizes}

    def _table(self, split: str) -> Fields:
        size = self.sizes[split]
        points, label = draw(size, self.noise, self.data_seed, list(self.sizes).index(split))
        inputs = torch.from_numpy(points).float()
        return Fields(
            input=inputs,
            target=torch.from_numpy(label),
            posterior=torch.from_numpy(posterior(inputs.double().numpy(), self.noise)).float(),
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
            "version": "moons 1",
            "noise": str(self.noise),
            "data_seed": str(self.data_seed),
            **{name: str(size) for name, size in self.sizes.items()},
            "sha256": digest.hexdigest(),
        }

    def picture(self, inputs: Tensor) -> np.ndarray:
        fields = self._tables["train"].fields
        return picture(shown(inputs), fields["input"].double().numpy(), fields["target"].numpy())
