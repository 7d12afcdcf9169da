"""Reading of the table beside the images: a line for each file, with its angles and optionally its split."""

import hashlib
import math
import posixpath
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple, cast

import numpy as np

from framework.datasets.angles import unlike_degrees, unlike_radians
from framework.datasets.csv_columns import (
    Chosen,
    Columns,
    Writing,
    numbers,
    numeric_columns,
    read_columns,
    require,
    told,
)
from framework.errors import DataError, did_you_mean, quote, shorten

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = ("train", "validation", "test")
SHARES = {"train": 0.70, "validation": 0.15, "test": 0.15}
FILE, SPLIT = "file", "split"


class Row(NamedTuple):
    """One image; its angles are in radians, in the order of the table's columns."""

    file: str
    split: Split
    angles: tuple[float, ...]


class Table(NamedTuple):
    """Rows and columns of a table of angles.

    Attributes:
        columns: names of the angles.
        rows: one row for each image.
        remarks: sentences on columns that were left out.
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

    Without `columns`, every column is an angle whose cells are mostly numbers, except row numbers. Without `angles_in`
    the angles are degrees, and a column that looks like radians is refused.

    Raises:
        DataError: the file is missing, or a header, cell or file name is wrong; the message names the line.
    """
    table = _read(file, writing or Writing())
    chosen = _angle_columns(table, columns)
    values = {column: numbers(table, column, missing="").tolist() for column in chosen.names}
    for column in chosen.names:
        _refuse_other_unit(file, column, np.array(values[column]), angles_in)
    turn = math.radians if angles_in != "radians" else float
    first_line: dict[str, int] = {}
    rows = []
    for index, (number, written) in enumerate(zip(table.lines, table.cells[FILE], strict=True)):
        name = posixpath.normpath(written) if written else ""  # `./a.png` is `a.png`: one image in one split
        if not name:
            raise DataError(f"{file} line {number}: no `{FILE}`; wanted the name of an image.")
        if name in first_line:
            raise DataError(
                f"{file} line {number}: {quote(written)} stands already in line {first_line[name]}; wanted each "
                "image once. Take one of the lines out."
            )
        first_line[name] = number
        split = _split(file, number, table.cells[SPLIT][index]) if SPLIT in table.cells else split_of(name)
        rows.append(Row(name, split, tuple(turn(values[column][index]) for column in chosen.names)))
    return Table(chosen.names, rows, told(chosen))


def split_of(name: str) -> Split:
    """Return train (70 %), validation or test (15 % each) by a hash of the name: new images never move old ones."""
    share = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8]) / 2**64
    for split in SPLITS:
        share -= SHARES[split]
        if share < 0:
            return split
    return SPLITS[-1]


def _read(file: Path, writing: Writing) -> Columns:
    """Return the table's cells, which include a column of files.

    Raises:
        DataError: `read_columns` raises it, or there is no such column.
    """
    missing = (
        f"wanted a table with a column `{FILE}` and a column for each angle. Write it, or name another with "
        "data.csv."
    )
    table = read_columns(file, writing, missing)
    if FILE not in table.cells:
        raise DataError(
            f"{file} has no column `{FILE}`.{did_you_mean(FILE, table.cells)} Its first line names: "
            f"{shorten(', '.join(table.cells))}. Wanted names, one of them `{FILE}`."
        )
    return table


def _angle_columns(table: Columns, asked: Sequence[str] | None) -> Chosen:
    if asked is None:
        found = numeric_columns(table, (FILE, SPLIT), "data.angle_columns")
        if not found.names:
            others = "".join(f" {quote(name)}: {why}." for name, why in list(found.left_out.items())[:8])
            raise DataError(
                f"{table.file} has no column of numbers beside `{FILE}` and `{SPLIT}`; wanted one for each angle, "
                f"in degrees. Add one, or name them with data.angle_columns.{others}"
            )
        return found
    require(table, asked, "data.angle_columns")
    if not asked:
        raise DataError(
            "data.angle_columns is empty; wanted the name of at least one column, or null for all."
        )
    names = tuple(dict.fromkeys(asked))
    others = [name for name in table.cells if name not in (*names, FILE, SPLIT)]
    return Chosen(names, dict(table.left_out) | dict.fromkeys(others, "not named in data.angle_columns"), {})


def _refuse_other_unit(
    file: Path, column: str, values: np.ndarray, angles_in: Literal["degrees", "radians"] | None
) -> None:
    wrong = unlike_degrees(values) if angles_in is None else ""
    if wrong:
        raise DataError(
            f"{file}, column {quote(column)}: {wrong}. Set data.angles_in=radians, or data.angles_in=degrees if "
            "degrees they are."
        )
    wrong = unlike_radians(values) if angles_in == "radians" else ""
    if wrong:
        raise DataError(
            f"{file}, column {quote(column)}: {wrong}. Leave data.angles_in out, or wrap the angles into one turn."
        )


def _split(file: Path, number: int, cell: str) -> Split:
    word = cell
    if word not in SPLITS:
        raise DataError(
            f"{file} line {number}, column `{SPLIT}`: {quote(word)}; wanted one of {', '.join(SPLITS)}."
            f"{did_you_mean(word, SPLITS)}"
        )
    return cast(Split, word)
