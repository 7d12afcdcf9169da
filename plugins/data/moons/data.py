"""The two moons with overlapping noise; the contract is framework.data's."""

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
from plugins.data.moons.generator import draw, posterior
from plugins.data.moons.points import TARGET, DataSeed, Size, fingerprint, picture, read_points, split_of


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
    target = TARGET
    input_shape = (2,)
    groups = ("moons",)
    synthetic = True
    skipped = 0
    varies = False
    plane = True

    def __init__(
        self,
        *,
        train: Size = 500,
        validation: Size = 500,
        test: Size = 5000,
        noise: Annotated[float, Field(ge=0.01, le=1, allow_inf_nan=False)] = 0.37,
        data_seed: DataSeed = 0,
    ) -> None:
        self.sizes = (train, validation, test)
        self.noise = noise
        self.data_seed = data_seed

    def prepare(self) -> None:
        self._splits = [self._drawn(size, number) for number, size in enumerate(self.sizes)]

    def _drawn(self, size: int, split: int) -> Fields:
        points, label = draw(size, self.noise, self.data_seed, split)
        inputs = torch.from_numpy(points).float()
        exact = posterior(inputs.double().numpy(), self.noise)
        return split_of(inputs, label, posterior=torch.from_numpy(exact).float())

    def splits(self) -> Splits:
        return Splits(*self._splits)

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return read_points(files)

    def augment(self, batch: Batch) -> Batch:
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        return fingerprint("moons 1", self._splits, noise=self.noise, data_seed=self.data_seed)

    def picture(self, inputs: Tensor) -> np.ndarray:
        return picture(inputs, self._splits[0])
