"""Reads the table beside the images: a line for each file, with its angles and perhaps its split."""

import hashlib
import math
import posixpath
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, cast

from framework.datasets.csv_columns import csv_rows
from framework.errors import DataError, did_you_mean, quoted, shown

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = ("train", "validation", "test")
SHARES = {"train": 0.70, "validation": 0.15, "test": 0.15}
FILE, SPLIT = "file", "split"
ENOUGH_ROWS = 20
"""With more rows than this, a column that stays within ±2π is taken for radians."""


class Row(NamedTuple):
    """One image; angles in radians, in the order of the table's columns."""

    file: str
    split: Split
    angles: tuple[float, ...]


class Table(NamedTuple):
    columns: tuple[str, ...]
    rows: list[Row]


def read_table(
    file: Path, columns: Sequence[str] | None, angles_in: Literal["degrees", "radians"] | None
) -> Table:
    """Read and check a CSV file; no `columns`: all whose cells are mostly numbers.

    Without `angles_in` the angles are degrees, and a column that looks like radians is refused.

    Raises:
        DataError: the file is missing, or a header, cell or file name is wrong; names the line.
    """
    header, lines = _read(file)
    columns = _angle_columns(file, header, lines, columns)
    values = {column: _numbers(file, column, lines) for column in columns}
    if angles_in is None:
        for column, numbers in values.items():
            _refuse_radians(file, column, numbers)
    turn = math.radians if angles_in != "radians" else float
    first_line: dict[str, int] = {}
    rows = []
    for index, (number, cells) in enumerate(lines.items()):
        written = cells[FILE].strip()
        name = posixpath.normpath(written) if written else ""  # `./a.png` is `a.png`: one image in one split
        if not name:
            raise DataError(f"{file} line {number}: no `{FILE}`; wanted the name of an image.")
        if name in first_line:
            raise DataError(
                f"{file} line {number}: {quoted(written)} stands already in line {first_line[name]}; wanted each "
                "image once. Take one of the lines out."
            )
        first_line[name] = number
        split = _split(file, number, cells[SPLIT]) if SPLIT in header else split_of(name)
        rows.append(Row(name, split, tuple(turn(values[column][index]) for column in columns)))
    return Table(tuple(columns), rows)


def split_of(name: str) -> Split:
    """Choose train (70 %), validation or test (15 % each) by a hash of the name: new images never move old ones."""
    share = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8]) / 2**64
    for split in SPLITS:
        share -= SHARES[split]
        if share < 0:
            return split
    return SPLITS[-1]


def _read(file: Path) -> tuple[list[str], dict[int, dict[str, str]]]:
    """Read the header, and the cells of every line by its number."""
    missing = (
        f"wanted a table with a column `{FILE}` and a column for each angle. Write it, or name another with "
        "data.csv."
    )
    with csv_rows(file, missing) as reader:
        header = [cell.strip() for cell in next(reader, [])]
        lines: dict[int, list[str]] = {}
        for cells in reader:
            if any(cell.strip() for cell in cells):
                lines[reader.line_num] = cells
    if FILE not in header:
        raise DataError(
            f"{file} has no column `{FILE}`.{did_you_mean(FILE, header)} Its first line names: "
            f"{shown(', '.join(header)) or 'nothing'}. Wanted names separated by commas, one of them `{FILE}`."
        )
    twice = [name for name, count in Counter(header).items() if count > 1]
    if twice:
        raise DataError(f"{file} names the column {quoted(twice[0])} twice; wanted each once. Rename one.")
    for number, cells in lines.items():
        if len(cells) != len(header):
            raise DataError(
                f"{file} line {number}: {len(cells)} cells; wanted {len(header)}, as many as the first line "
                "names. Mend that line."
            )
    if not lines:
        raise DataError(f"{file} has no line below its first; wanted one for each image.")
    return header, {number: dict(zip(header, cells, strict=True)) for number, cells in lines.items()}


def _angle_columns(
    file: Path, header: Sequence[str], lines: Mapping[int, Mapping[str, str]], asked: Sequence[str] | None
) -> Sequence[str]:
    if asked is None:
        others = [name for name in header if name not in (FILE, SPLIT)]
        found = [
            name
            for name in others
            if 2 * sum(_is_number(cells[name]) for cells in lines.values()) > len(lines)
        ]
        if not found:
            raise DataError(
                f"{file} has no column of numbers beside `{FILE}` and `{SPLIT}`; wanted one for each angle, "
                "in degrees. Add one, or name them with data.angle_columns."
            )
        return found
    for name in asked:
        if name not in header:
            raise DataError(
                f"data.angle_columns names {name!r}, which {file} does not have."
                f"{did_you_mean(name, header)} Its columns: {shown(', '.join(header))}."
            )
    if not asked:
        raise DataError(
            "data.angle_columns is empty; wanted the name of at least one column, or null for all."
        )
    return list(dict.fromkeys(asked))


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell  # which Python reads and no table means


def _numbers(file: Path, column: str, lines: Mapping[int, Mapping[str, str]]) -> list[float]:
    numbers = []
    for number, cells in lines.items():
        cell = cells[column]
        if not _is_number(cell) or not math.isfinite(float(cell)):
            raise DataError(
                f"{file} line {number}, column {quoted(column)}: {quoted(cell)}; wanted a finite number of degrees. "
                "Mend the cell, or take the line out."
            )
        numbers.append(float(cell))
    return numbers


def _refuse_radians(file: Path, column: str, numbers: Sequence[float]) -> None:
    largest = max(map(abs, numbers))
    if len(numbers) > ENOUGH_ROWS and 0 < largest <= 2 * math.pi:
        raise DataError(
            f"{file}, column {quoted(column)}: none of {len(numbers)} values exceeds {largest:.4g}: this looks "
            "like radians; wanted degrees. Set angles_in: radians, or angles_in: degrees if degrees they are."
        )


def _split(file: Path, number: int, cell: str) -> Split:
    word = cell.strip()
    if word not in SPLITS:
        raise DataError(
            f"{file} line {number}, column `{SPLIT}`: {quoted(word)}; wanted one of {', '.join(SPLITS)}."
            f"{did_you_mean(word, SPLITS)}"
        )
    return cast(Split, word)
