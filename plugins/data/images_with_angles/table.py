"""Reading of the table of the images, which has a line for each image with its angles and optionally its split."""

import hashlib
import math
import posixpath
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple, cast

import numpy as np

from framework.datasets.angles import unlike_degrees, unlike_radians
from framework.datasets.csv_columns import (
    ColumnChoice,
    Columns,
    Writing,
    describe_choice,
    numbers,
    numeric_columns,
    read_columns,
    require,
)
from framework.errors import DataError, did_you_mean, quote, shorten

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = ("train", "validation", "test")
SHARES = {"train": 0.70, "validation": 0.15, "test": 0.15}
FILE, SPLIT = "file", "split"


class Row(NamedTuple):
    """One image: its file, its split, and its angles in radians, in the order of `Table.columns`."""

    file: str
    split: Split
    angles: tuple[float, ...]


class Table(NamedTuple):
    """Content of a table of angles.

    Attributes:
        columns: Names of the angles.
        rows: Rows of the table, one for each image.
        remarks: Clauses about columns that were left out.
    """

    columns: tuple[str, ...]
    rows: list[Row]
    remarks: tuple[str, ...] = ()


def read_table(
    file: Path,
    columns: Sequence[str] | None,
    angles_in: Literal["degrees", "radians"] | None,
    writing: Writing | None = None,
) -> Table:
    """Read and check a CSV file.

    Without `columns`, every column whose cells are mostly numbers is an angle, except a column of row numbers. Without
    `angles_in` the angles are degrees, and a column that looks like radians is refused.

    Raises:
        DataError: The file is missing, or a header, cell or file name is wrong; the message names the line.
    """
    table = _read(file, writing or Writing())
    chosen = _angle_columns(table, columns)
    values = {column: numbers(table, column, missing="").tolist() for column in chosen.names}
    for column in chosen.names:
        _refuse_other_unit(file, column, np.array(values[column]), angles_in)
    to_radians = math.radians if angles_in != "radians" else float
    first_line: dict[str, int] = {}
    rows = []
    for index, (number, path) in enumerate(zip(table.lines, table.cells[FILE], strict=True)):
        # `./a.png` and `a.png` are the same image, which must be in one split only
        name = posixpath.normpath(path) if path else ""
        if not name:
            raise DataError(
                f"{file} line {number}: The column `{FILE}` is empty. Write the name of an image there."
            )
        if name in first_line:
            raise DataError(
                f"{file} line {number}: {quote(path)} is already listed in line {first_line[name]}. Remove one of the "
                "two lines."
            )
        first_line[name] = number
        split = _split(file, number, table.cells[SPLIT][index]) if SPLIT in table.cells else split_of(name)
        rows.append(Row(name, split, tuple(to_radians(values[column][index]) for column in chosen.names)))
    return Table(chosen.names, rows, describe_choice(chosen))


def split_of(name: str) -> Split:
    """Return train (70 %), validation (15 %) or test (15 %), chosen by a hash of the name.

    Adding images therefore never moves other images to another split.
    """
    share = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8]) / 2**64
    for split in SPLITS:
        share -= SHARES[split]
        if share < 0:
            return split
    return SPLITS[-1]


def _read(file: Path, writing: Writing) -> Columns:
    """Return the cells of a table, after checking that it has a column of file names.

    Raises:
        DataError: The table cannot be read, or has no such column.
    """
    missing = (
        f"expected a table with a column `{FILE}` and a column for each angle. Write such a table, or set data.csv to "
        "the path of another table."
    )
    table = read_columns(file, writing, missing)
    if FILE not in table.cells:
        raise DataError(
            f"{file} has no column `{FILE}`.{did_you_mean(FILE, table.cells)} Its first line names "
            f"{shorten(', '.join(table.cells))}. Name the column of the images `{FILE}`."
        )
    return table


def _angle_columns(table: Columns, requested: Sequence[str] | None) -> ColumnChoice:
    """Return the columns of angles: those requested, or all columns of numbers."""
    if requested is None:
        choice = numeric_columns(table, (FILE, SPLIT), "data.angle_columns")
        if not choice.names:
            reasons = "".join(f" {quote(name)}: {why}." for name, why in list(choice.left_out.items())[:8])
            raise DataError(
                f"{table.file} has no column of numbers besides `{FILE}` and `{SPLIT}`, but needs one for each angle, "
                f"in degrees. Add such columns, or list their names in data.angle_columns.{reasons}"
            )
        return choice
    require(table, requested, "data.angle_columns")
    if not requested:
        raise DataError(
            "data.angle_columns is empty. List the name of at least one column, or set it to null for all columns."
        )
    names = tuple(dict.fromkeys(requested))
    unread = [name for name in table.cells if name not in (*names, FILE, SPLIT)]
    return ColumnChoice(
        names, dict(table.left_out) | dict.fromkeys(unread, "not named in data.angle_columns"), {}
    )


def _refuse_other_unit(
    file: Path, column: str, values: np.ndarray, angles_in: Literal["degrees", "radians"] | None
) -> None:
    wrong = unlike_degrees(values) if angles_in is None else ""
    if wrong:
        raise DataError(
            f"{file}, column {quote(column)}: {wrong}. Set data.angles_in=radians, or data.angles_in=degrees if "
            "the angles are in degrees."
        )
    wrong = unlike_radians(values) if angles_in == "radians" else ""
    if wrong:
        raise DataError(
            f"{file}, column {quote(column)}: {wrong}. Leave data.angles_in out, or wrap the angles to one turn."
        )


def _split(file: Path, number: int, word: str) -> Split:
    """Return the split that a cell in line `number` names."""
    if word not in SPLITS:
        raise DataError(
            f"{file} line {number}, column `{SPLIT}`: {quote(word)} is no split. Write one of {', '.join(SPLITS)}."
            f"{did_you_mean(word, SPLITS)}"
        )
    return cast(Split, word)
