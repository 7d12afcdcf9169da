"""Points on a wave, with more noise to the right."""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from framework.data import Batch, Data, Splits
from framework.datasets.fields import Fields
from framework.errors import DataError
from framework.target import Target


class Example(Data):
    """Points (x, y) with y = sin 3x + noise, to predict y from x. The noise grows with x; the data are generated.

    Files for `mode=predict` are NumPy arrays (.npy) of one number x per row, (rows, 1).

    Args:
        samples: number of points; three fifths are for training, and one fifth each for validation and test.
        noise: standard deviation of the noise at x = 1; it is 0 at x = -1.
        data_seed: seed of the points.
    """

    bibtex = ""
    suffixes = (".npy",)

    def __init__(
        self,
        *,
        samples: Annotated[int, Field(ge=20)] = 1000,
        noise: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.3,
        data_seed: Annotated[int, Field(ge=0)] = 0,
    ) -> None:
        self.samples = samples
        self.noise = noise
        self.data_seed = data_seed

    def prepare(self) -> None:
        """Generate the points, and set the attributes."""
        random = np.random.default_rng(self.data_seed)
        x = random.uniform(-1, 1, self.samples)
        y = np.sin(3 * x) + self.noise * (1 + x) / 2 * random.standard_normal(self.samples)
        self.x, self.y = (torch.from_numpy(values[:, None]).float() for values in (x, y))
        self.target = Target("real", ("y",))
        self.input_shape = (1,)
        self.columns = ("x",)
        self.groups = ("wave",)
        self.varies = False
        self.synthetic = True

    def splits(self) -> Splits:
        """Return the three splits."""
        ends = (0, 3 * self.samples // 5, 4 * self.samples // 5, self.samples)
        return Splits(*(self._part(slice(*rows)) for rows in pairwise(ends)))

    def _part(self, rows: slice) -> Fields:
        count = len(self.x[rows])
        return Fields(
            input=self.x[rows],
            target=self.y[rows],
            index=torch.arange(count),
            group=torch.zeros(count, dtype=torch.int64),
        )

    def read(self, files: Sequence[Path]) -> Fields:
        """Return the samples of the user's files."""
        if not files:
            raise DataError("Got no file, but at least one is required. Give .npy files of shape (rows, 1).")
        inputs = torch.cat([read_array(file) for file in files])
        return Fields(input=inputs, index=torch.arange(len(inputs)))

    def augment(self, batch: Batch) -> Batch:
        """Return the batch itself."""
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        """Return entries that identify the data: name, number of samples, noise and seed."""
        return {
            "name": "example 1",
            "samples": str(self.samples),
            "noise": str(self.noise),
            "seed": str(self.data_seed),
        }

    def preview(self, inputs: Tensor) -> np.ndarray:
        """Return an image of a scale from -1 to 1, with a black line at x."""
        image = np.full((16, 65, 3), 255, dtype=np.uint8)
        image[:, round(32 + 32 * float(inputs.clamp(-1, 1)))] = 0
        return image


def read_array(file: Path) -> Tensor:
    """Return the numbers of a .npy file, (rows, 1) float32.

    Raises:
        DataError: the file cannot be read, or holds anything but finite real numbers of this shape.
    """
    try:
        numbers = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DataError(
            f"{file} cannot be read as a NumPy array: {error}. Write it with numpy.save."
        ) from error
    if numbers.ndim != 2 or numbers.shape[1] != 1 or numbers.dtype.kind not in "iuf":
        raise DataError(
            f"{file} holds an array of shape {numbers.shape} and type {numbers.dtype}, but real numbers of the shape "
            "(rows, 1) are required. Write one x per row."
        )
    if not np.isfinite(numbers).all():
        row = math.floor(np.argmin(np.isfinite(numbers[:, 0])))
        raise DataError(f"{file} holds {numbers[row, 0]} in row {row}, but finite numbers are required.")
    return torch.from_numpy(numbers.astype(np.float32))
