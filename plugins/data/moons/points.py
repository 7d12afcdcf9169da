"""Labelled points in the plane: splits, reading of a user's files, and an image of the points."""

import hashlib
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt8
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.data import Batch, Data, Splits
from framework.datasets.csv_columns import tables
from framework.datasets.fields import Fields
from framework.errors import DataError
from framework.target import Target

Size = Annotated[int, Field(ge=1, le=10_000_000)]
DataSeed = Annotated[int, Field(ge=0, lt=2**31)]
TARGET = Target("class", ("upper", "lower"))
SIDE = 96
"""Side of the image, pixels."""
HALF_SIDE = 4.0
"""Half the side of the square [-4, 4]² that the image shows; thesis §2.3.5 draws outliers in this square."""
COLOURS = np.array([[31, 119, 180], [255, 127, 14]], np.uint8)


@dataclass(frozen=True, kw_only=True)
class Draws:
    """Number of points of each split, and the seed of their draws; the seed of the run does not change the points."""

    train: Size = 500
    validation: Size = 500
    test: Size = 5000
    data_seed: DataSeed = 0


class PlanePoints(Data):
    """Base class of data sets of labelled points in the plane, whose splits are drawn independently.

    A data set adds its constructor, its citation, `draw_split` and `fingerprint`.
    """

    target = TARGET
    input_shape = (2,)
    synthetic = True
    skipped = 0
    suffixes = (".csv",)
    varies = False
    draws: Draws

    @abstractmethod
    def draw_split(self, size: int, split: int) -> Fields:
        """Return `size` random points of split number `split` (0 training, 1 validation, 2 test)."""

    def prepare(self) -> None:
        sizes = (self.draws.train, self.draws.validation, self.draws.test)
        self._splits = [self.draw_split(size, number) for number, size in enumerate(sizes)]

    def splits(self) -> Splits:
        return Splits(*self._splits)

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return read_points(files)

    def augment(self, batch: Batch) -> Batch:
        return batch

    def preview(self, inputs: Tensor) -> np.ndarray:
        return draw_point(inputs, self._splits[0])


def split_of(inputs: Float32[Tensor, "size 2"], label: Int[np.ndarray, "size"], **more: Tensor) -> Fields:
    """Return a split that consists of points, their labels and further fields; "group" is 0 for all points."""
    return Fields(
        input=inputs,
        target=torch.from_numpy(label),
        **more,
        group=torch.zeros(len(inputs), dtype=torch.int64),
        index=torch.arange(len(inputs)),
    )


def fingerprint(version: str, splits: Sequence[Fields], **parameters: object) -> dict[str, str]:
    """Return the entries that identify a data set: its parameters, the sizes of its splits, a hash of its points.

    Args:
        version: Version of the generator.
        splits: The three splits.
        parameters: Parameters of the data set, by name.
    """
    digest = hashlib.sha256()
    for split in splits:
        digest.update(split.fields["input"].numpy().tobytes())
    return {
        "root": "generated",
        "version": version,
        **{name: str(value) for name, value in parameters.items()},
        **{name: str(len(split)) for name, split in zip(Splits._fields, splits, strict=True)},
        "sha256": digest.hexdigest(),
    }


def read_points(files: Sequence[Path]) -> Fields:
    """Read the columns `x` and `y` of CSV files, one sample for each row.

    The numbers are used as they are, so that they must be in the units of the training inputs.

    Raises:
        DataError: There is no file, or a file cannot be read, lacks a column, or holds a cell that is not a finite
            number; the message names the file.
    """
    points_of_files = []
    for columns, points in tables(files, ("x", "y"), "A file of points"):
        too_large = np.flatnonzero(np.abs(points).max(-1) > np.finfo(np.float32).max)
        if len(too_large):
            x, y = points[too_large[0]]
            raise DataError(
                f"{columns.file} line {columns.lines[too_large[0]]}: The point ({x:g}, {y:g}) lies beyond single "
                "precision (3.4e38). Give points in the units of the training data, at most a few units from 0."
            )
        points_of_files.append(points)
    points = np.concatenate(points_of_files)
    return Fields(input=torch.from_numpy(points).float(), index=torch.arange(len(points)))


def draw_point(inputs: Float[Tensor, "2"], split: Fields) -> UInt8[np.ndarray, "side side 3"]:
    """Return an image of all points of a split, coloured by class, with a black cross at the point `inputs`.

    The cross of a point outside of the image lies at the border.
    """
    point = inputs.detach().cpu().double().numpy()
    cloud, label = split.fields["input"].double().numpy(), split.fields["target"].numpy()
    canvas = np.full((SIDE, SIDE, 3), 255, np.uint8)
    row, column = _pixel(cloud)
    canvas[row, column] = COLOURS[label]
    row, column = _pixel(point[None].clip(-HALF_SIDE, HALF_SIDE))
    arm = np.arange(-4, 5)
    for rows, columns in ((row + arm, column + 0 * arm), (row + 0 * arm, column + arm)):
        inside = (rows >= 0) & (rows < SIDE) & (columns >= 0) & (columns < SIDE)
        canvas[rows[inside], columns[inside]] = 0
    return canvas


def _pixel(points: Float[np.ndarray, "*batch 2"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the row and the column of points in the image, whose y axis points upwards."""
    pixel = ((points + HALF_SIDE) / (2 * HALF_SIDE) * SIDE).astype(np.int64).clip(0, SIDE - 1)
    return SIDE - 1 - pixel[..., 1], pixel[..., 0]
