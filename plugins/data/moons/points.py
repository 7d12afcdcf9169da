"""Points of the plane from a user's files, and as a person would see them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from framework.datasets.csv_columns import numbers, read_columns, require
from framework.datasets.fields import Fields
from framework.errors import DataError

LABELS = ("upper", "lower")
SIDE = 96
"""Pixels of a picture."""
REACH = 4.0
"""A picture shows [-4, 4]², the square in which thesis §2.3.5 draws outliers."""
COLOURS = np.array([[31, 119, 180], [255, 127, 14]], np.uint8)


def read_points(files: Sequence[Path]) -> Fields:
    """The columns `x` and `y` of CSV files, in standard units, one sample a row.

    Raises:
        DataError: a file cannot be read, lacks a column, or holds a cell that is no finite number; names it.
    """
    tables = []
    for file in files:
        columns = read_columns(Path(file))
        require(columns, ("x", "y"), "A file of points")
        points = np.stack([numbers(columns, name, missing="") for name in ("x", "y")], -1)
        wide = np.flatnonzero(np.abs(points).max(-1) > np.finfo(np.float32).max)
        if len(wide):
            x, y = points[wide[0]]
            raise DataError(
                f"{file} line {columns.lines[wide[0]]}: ({x:g}, {y:g}) lies beyond single precision (3.4e38); wanted "
                "points in the units of the training data, some units from 0. Mend it."
            )
        tables.append(points)
    points = np.concatenate(tables)
    return Fields(input=torch.from_numpy(points).float(), index=torch.arange(len(points)))


def picture(
    point: Float[np.ndarray, "2"], cloud: Float[np.ndarray, "size 2"], label: Int[np.ndarray, "size"]
) -> UInt8[np.ndarray, "side side 3"]:
    """The cloud in two colours on white, and a black cross at the point, at the border where it lies outside."""
    canvas = np.full((SIDE, SIDE, 3), 255, np.uint8)
    row, column = _pixel(cloud)
    canvas[row, column] = COLOURS[label]
    row, column = _pixel(point[None].clip(-REACH, REACH))
    arm = np.arange(-4, 5)
    for rows, columns in ((row + arm, column + 0 * arm), (row + 0 * arm, column + arm)):
        inside = (rows >= 0) & (rows < SIDE) & (columns >= 0) & (columns < SIDE)
        canvas[rows[inside], columns[inside]] = 0
    return canvas


def shown(inputs: Tensor) -> Float[np.ndarray, "2"]:
    """One input as NumPy has it."""
    return inputs.detach().cpu().double().numpy()


def _pixel(points: Float[np.ndarray, "*batch 2"]) -> tuple[np.ndarray, np.ndarray]:
    """Row and column, the y axis upwards."""
    place = ((points + REACH) / (2 * REACH) * SIDE).astype(np.int64).clip(0, SIDE - 1)
    return SIDE - 1 - place[..., 1], place[..., 0]
