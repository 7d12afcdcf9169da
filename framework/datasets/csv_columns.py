"""A table of numbers and words in a CSV file, by columns; what is wrong with it is said by line and column."""

import csv
import io
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from framework.errors import DataError, did_you_mean, quoted, shown
from framework.storage.limits import MOST_TABLE_COLUMNS as MOST_COLUMNS
from framework.storage.reading import guarded, opened

MISSING = {"", "na", "n/a", "nan", "null", "none", "?"}
"""What stands in a cell, in small letters, that has no number."""
SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars"}


class Columns(NamedTuple):
    """A file's cells by column, without surrounding blanks, and the number of the line each row ends on."""

    file: Path
    cells: dict[str, list[str]]
    lines: list[int]


@contextmanager
def csv_rows(file: Path, missing: str) -> Iterator[Any]:
    """The rows of a CSV file as lists of cells: UTF-8 (also with a byte-order mark), commas.

    Args:
        missing: what to say of a file that is not there.

    Raises:
        DataError: it is missing or unreadable.
    """
    with (
        guarded(file, "a table", "Save it as the wanted UTF-8 text, separated by commas.", missing),
        opened(file) as stream,
        io.TextIOWrapper(stream, encoding="utf-8-sig", newline="") as text,
    ):
        yield csv.reader(text, strict=True)


def read_columns(file: Path) -> Columns:
    """Read a CSV file: UTF-8 (also with a byte-order mark), commas, names in its first line; blank lines are left out.

    Raises:
        DataError: it is missing, unreadable, empty, separated by something else, a name is missing or stands twice,
            there is no row, or a row has more or fewer cells than there are names.
    """
    with csv_rows(file, "wanted a CSV table. Mend the path.") as reader:
        header = [cell.strip() for cell in next(reader, [])]
        _check_header(file, header)
        columns: list[list[str]] = [[] for _ in header]  # a list for each row would take most of the memory
        lines: list[int] = []
        for cells in reader:
            # a spreadsheet's `,,,`; in a table of one column an empty cell is a row that misses its number
            if not cells or (len(cells) > 1 and not any(map(str.strip, cells))):
                continue
            if len(cells) != len(header):
                raise DataError(
                    f"{file} line {reader.line_num}: {len(cells)} cells; wanted {len(header)}, as many as the "
                    "first line names. Mend that line."
                )
            for column, cell in zip(columns, cells, strict=True):
                column.append(cell.strip())
            lines.append(reader.line_num)
    if not lines:
        raise DataError(f"{file} has no row below its first line; wanted one for each sample. Add them.")
    return Columns(file, dict(zip(header, columns, strict=True)), lines)


def require(columns: Columns, names: Sequence[str], asked: str) -> None:
    """Refuse names that are no columns.

    Args:
        asked: who names them, "data.columns" say.

    Raises:
        DataError: with the nearest name there is.
    """
    for name in names:
        if name not in columns.cells:
            raise DataError(
                f"{asked} names {name!r}, which {columns.file} does not have.{did_you_mean(name, columns.cells)} "
                f"Its columns: {shown(', '.join(columns.cells))}."
            )


def tables(
    files: Sequence[Path], names: Sequence[str], asked: str
) -> Iterator[tuple[Columns, Float[np.ndarray, "rows names"]]]:
    """A user's own files one after the other, each with its columns of these names as numbers.

    Raises:
        DataError: there is no file; or as `read_columns`, `require` and `numbers`.
    """
    if not files:
        raise DataError(f"No file was given; wanted at least one CSV table with {', '.join(names)}.")
    for file in files:
        columns = read_columns(Path(file))
        require(columns, names, asked)
        yield columns, np.stack([numbers(columns, name, missing="") for name in names], -1)


def mostly_numbers(columns: Columns, name: str) -> bool:
    """Whether more than half of a column's cells that are not empty are numbers; not so where all are empty."""
    if _all_finite(columns.cells[name]) is not None:
        return True
    filled = [cell for cell in columns.cells[name] if cell.lower() not in MISSING]
    return 2 * sum(number(cell) is not None for cell in filled) > len(filled)


def number(cell: str) -> float | None:
    """What a cell says in figures, perhaps infinite; NaN where it says that there is none; None where it is a word."""
    if cell.lower() in MISSING:
        return math.nan
    try:
        return None if "_" in cell else float(cell)  # 1_0: Python reads it and no table means it
    except ValueError:
        return None


def numbers(columns: Columns, name: str, *, missing: str | None) -> Float[np.ndarray, "rows"]:
    """A column as float64, NaN where it has no number.

    Args:
        missing: None lets numbers be missing; otherwise what else could be done about one, a clause for the message.

    Raises:
        DataError: a cell is a word, is infinite, or is missing and must not be; names the first.
    """
    plain = _all_finite(columns.cells[name])
    if plain is not None:
        return plain
    found = np.empty(len(columns.lines))
    for row, cell in enumerate(columns.cells[name]):
        value = number(cell)
        if value is None or math.isinf(value) or (missing is not None and math.isnan(value)):
            hint = ""
            if value is None and number(cell.replace(",", ".")) is not None:
                hint = " Decimals are written with a point."
            elif value is not None and math.isnan(value) and missing:
                hint = f" Or {missing}."
            raise DataError(
                f"{columns.file} line {columns.lines[row]}, column {quoted(name)}: {quoted(cell)}; wanted a finite "
                f"number. Mend the cell, or take the line out.{hint}"
            )
        found[row] = value
    return found


def _all_finite(cells: Sequence[str]) -> Float[np.ndarray, "rows"] | None:
    """The cells as `number` has them, several times as fast; None unless all are finite numbers."""
    try:
        found = np.fromiter(map(float, cells), np.float64, len(cells))
    except ValueError:
        return None
    return found if np.isfinite(found).all() and "_" not in "".join(cells) else None


def _check_header(file: Path, header: Sequence[str]) -> None:
    if len(header) > MOST_COLUMNS:
        raise DataError(f"{file} has {len(header)} columns; wanted at most {MOST_COLUMNS}. Leave some out.")
    if not any(header):
        raise DataError(f"{file} is empty or begins with a blank line; wanted names of columns. Write them.")
    if len(header) == 1:
        for sign, word in SEPARATORS.items():
            if sign in header[0]:
                raise DataError(
                    f"{file} is separated by {word}: its first line reads {quoted(header[0])}; wanted commas, and "
                    "decimals with a point. Save it as such."
                )
    if "" in header:
        raise DataError(
            f"{file}: column {header.index('') + 1} has no name (a row number that a program wrote, perhaps). "
            "Name it in the first line, or take the column out."
        )
    twice = [name for name, count in Counter(header).items() if count > 1]
    if twice:
        raise DataError(f"{file} names the column {quoted(twice[0])} twice; wanted each once. Rename one.")
