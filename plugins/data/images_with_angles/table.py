"""Reading of the table of the images, which has a line for each image with its angles and optionally its split."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from framework.datasets.angles import unlike_degrees, unlike_radians
from framework.datasets.csv_columns import (
    ColumnChoice,
    Columns,
    Writing,
    describe_choice,
    numbers,
    numeric_columns,
    require,
)
from framework.datasets.file_columns import FILE, SPLIT, Split, list_files, read_file_columns, split_of
from framework.errors import DataError, quote


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
        states_splits: Whether a column states the split of each image.
    """

    columns: tuple[str, ...]
    rows: list[Row]
    remarks: tuple[str, ...] = ()
    states_splits: bool = False


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
    table = read_file_columns(
        file,
        writing,
        f"expected a table with a column `{FILE}` and a column for each angle. Write such a table, or set data.csv to "
        "the path of another table.",
    )
    chosen = _angle_columns(table, columns)
    values = {column: numbers(table, column, missing="").tolist() for column in chosen.names}
    for column in chosen.names:
        _refuse_other_unit(file, column, np.array(values[column]), angles_in, columns is None)
    to_radians = math.radians if angles_in != "radians" else float
    rows = [
        Row(
            name, split or split_of(name), tuple(to_radians(values[column][index]) for column in chosen.names)
        )
        for index, (name, split) in enumerate(list_files(table))
    ]
    return Table(chosen.names, rows, describe_choice(chosen), SPLIT in table.cells)


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
    file: Path,
    column: str,
    values: np.ndarray,
    angles_in: Literal["degrees", "radians"] | None,
    chosen_by_content: bool,
) -> None:
    """Refuse a column whose unit seems to be another one; it may also be no angle, if nobody named the column."""
    no_angle = (
        " If the column holds no angles, list the columns of angles in data.angle_columns."
        if chosen_by_content
        else ""
    )
    wrong = unlike_degrees(values) if angles_in is None else ""
    if wrong:
        raise DataError(
            f"{file}, column {quote(column)}: {wrong}. Set data.angles_in=radians, or data.angles_in=degrees if "
            f"the angles are in degrees.{no_angle}"
        )
    wrong = unlike_radians(values) if angles_in == "radians" else ""
    if wrong:
        raise DataError(
            f"{file}, column {quote(column)}: {wrong}. Leave data.angles_in out, or wrap the angles to one "
            f"turn.{no_angle}"
        )
