"""The columns `file` and `split` of a user's CSV table."""

import hashlib
import posixpath
from collections.abc import Collection, Iterator
from pathlib import Path, PureWindowsPath
from typing import Literal, cast

from framework.datasets.class_folders import OTHER_NAMES
from framework.datasets.csv_columns import Columns, Writing, read_columns
from framework.errors import DataError, did_you_mean, quote, shorten
from framework.storage.names import is_within

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = ("train", "validation", "test")
SHARES = {"train": 0.70, "validation": 0.15, "test": 0.15}
FILE, SPLIT = "file", "split"


def read_file_columns(file: Path, writing: Writing | None, missing: str) -> Columns:
    """Return the cells of a table, after checking that it has a column of file names.

    Args:
        file: Path of the table.
        writing: Notation of the table; None: decimal points and no units.
        missing: End of the message about a table that does not exist.

    Raises:
        DataError: The table cannot be read, or has no such column.
    """
    table = read_columns(file, writing, missing)
    if FILE not in table.cells:
        raise DataError(
            f"{file} has no column `{FILE}`.{did_you_mean(FILE, table.cells)} Its first line names "
            f"{shorten(', '.join(table.cells))}. Name the column of the images `{FILE}`."
        )
    return table


def refuse_other_split(table: Columns, but: Collection[str] = ()) -> None:
    """Refuse a table without a column `split` in which another column seems to assign each row to a split.

    Such a column would not be read, so that rows for the test could be used for training.

    Args:
        table: The table.
        but: Columns that have another meaning.

    Raises:
        DataError: A column holds nothing but names of splits (`OTHER_NAMES`), of at least two splits.
    """
    if SPLIT in table.cells:
        return
    for name, cells in table.cells.items():
        if name in but or cells[0].lower() not in OTHER_NAMES:
            continue
        splits = {OTHER_NAMES.get(cell.lower()) for cell in set(cells)}
        if None not in splits and len(splits) > 1:
            raise DataError(
                f"{table.file}: The column {quote(name)} seems to assign each row to a split, but only a column named "
                f"`{SPLIT}` does so. Name it `{SPLIT}` and write {', '.join(SPLITS)} into its cells, or remove it."
            )


def list_files(table: Columns) -> Iterator[tuple[str, Split | None]]:
    """Yield the file and the split of each row; the split is None if the table has no column of splits.

    Raises:
        DataError: A name of a file is missing, leads out of the folder or occurs twice, or a split is unknown; the
            message then names the line. The error is also raised if the column of splits has another name.
    """
    refuse_other_split(table)
    first_line: dict[str, int] = {}
    for index, (number, path) in enumerate(zip(table.lines, table.cells[FILE], strict=True)):
        # `./a.png` and `a.png` are the same image, which must be in one split only
        name = posixpath.normpath(path) if path else ""
        if not name:
            raise DataError(
                f"{table.file} line {number}: The column `{FILE}` is empty. Write the name of an image there."
            )
        if posixpath.isabs(name) or PureWindowsPath(path).is_absolute():
            raise DataError(
                f"{table.file} line {number}: {quote(path)} is an absolute path, but paths relative to data.root are "
                "required. Remove the part of the path that is data.root, or set data.root to a folder that contains "
                "all images."
            )
        if not is_within(name):
            raise DataError(
                f"{table.file} line {number}: {quote(path)} lies outside of the folder of the data. Write a path below "
                "data.root, or set data.root to a folder that contains all images."
            )
        if name in first_line:
            raise DataError(
                f"{table.file} line {number}: {quote(path)} is already listed in line {first_line[name]}. Remove one "
                "of the two lines."
            )
        first_line[name] = number
        word = table.cells[SPLIT][index] if SPLIT in table.cells else None
        if word is not None and word not in SPLITS:
            raise DataError(
                f"{table.file} line {number}, column `{SPLIT}`: {quote(word)} is not a split. Write one of "
                f"{', '.join(SPLITS)}.{suggest_split(word)}"
            )
        yield name, cast(Split | None, word)


def suggest_split(word: str) -> str:
    """Return ' Did you mean ...?' for a word that means a split; "" for other words."""
    split = OTHER_NAMES.get(word.lower())
    return f" Did you mean '{split}'?" if split else did_you_mean(word, SPLITS)


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
