"""Columns of 0 and 1: one for each level of a column of words, and one for each column of numbers with missing cells.

A level is a word that occurs in a column. The empty level marks missing cells: the column `age=` is 1 where the column
`age` holds no number.
"""

import logging
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from framework.datasets.csv_columns import Columns, numeric_columns
from framework.errors import quote

MOST_LEVELS = 50
"""Largest number of levels of a column; a column with more is left out, since it holds names or free text."""
HOLES = frozenset(("", "nan", "none", "<na>", "nat"))
"""Texts, in small letters, of missing values in memory."""
_log = logging.getLogger(__name__)


def name_of(column: str, level: str) -> str:
    """Return the name of the column of 0 and 1 that says whether `column` has this level."""
    return f"{column}={level}"


def expand_words(cells: Columns, but: Collection[str]) -> tuple[Columns, Mapping[str, tuple[str, ...]]]:
    """Return the table with each column of words replaced by one column of 0 and 1 for each of its levels.

    The names of the new columns are returned too, by the name of the column that they replace. Columns with fewer than
    two or more than MOST_LEVELS levels stay as they are.

    Args:
        cells: The table.
        but: Names of columns that stay as they are, because they are used for something else.
    """
    reasons = numeric_columns(cells, but, "data.columns").left_out
    columns: dict[str, list[str]] = {}
    expanded: dict[str, tuple[str, ...]] = {}
    for name, words in cells.cells.items():
        levels = sorted(_levels(cells, name)) if reasons.get(name, "").startswith(("words", "dates")) else []
        names = tuple(name_of(name, level) for level in levels)
        if not 2 <= len(levels) <= MOST_LEVELS or any(part in cells.cells for part in names):
            columns[name] = words
            continue
        expanded[name] = names
        for part, level in zip(names, levels, strict=True):
            columns[part] = _indicator(words, level)
    return replace(cells, cells=columns), expanded


def explain_many_levels(cells: Columns, left_out: Mapping[str, str]) -> dict[str, str]:
    """Return the reasons why columns are left out, with the number of words of the columns that have too many."""
    reasons = dict(left_out)
    for name, why in left_out.items():
        count = len(_levels(cells, name)) if why == "words" else 0
        if count > MOST_LEVELS:
            reasons[name] = f"{count} different words; at most {MOST_LEVELS} are read"
    return reasons


def add_levels(cells: Columns, names: Sequence[str]) -> Columns:
    """Return the table with added columns of the levels that a model reads, computed from the table's words.

    A warning names levels in the table that the model does not know.

    Args:
        cells: The table, with columns of words.
        names: Columns that a model reads, among them the columns of levels.
    """
    columns = dict(cells.cells)
    for column, levels in known_levels(names, cells.cells).items():
        for level in levels:
            columns[name_of(column, level)] = _indicator(cells.cells[column], level, cells.notation.missing)
        if levels != [""]:
            unknown = _levels(cells, column)
            report_unknown({word: count for word, count in unknown.items() if word not in levels}, column)
    return replace(cells, cells=columns)


def known_levels(names: Sequence[str], present: Collection[Any]) -> dict[str, list[str]]:
    """Return, for each column of words in a table, the levels that a model reads from it, by the name of the column.

    Args:
        names: Columns that the model reads.
        present: Columns of the table.
    """
    levels: dict[str, list[str]] = {}
    for name in names:
        column, mark, level = name.partition("=")
        if name not in present and mark and column in present:
            levels.setdefault(column, []).append(level)
    return levels


def levels_in_memory(user_data: Any, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the columns of levels that a model reads, computed from columns of words in memory.

    Args:
        user_data: Rows in memory, such as a DataFrame.
        names: Columns that the model reads, among them the columns of levels.
    """
    columns: dict[str, np.ndarray] = {}
    for column, levels in known_levels(names, [*user_data]).items():
        words = np.array([str(word).strip() for word in np.atleast_1d(np.asarray(user_data[column], object))])
        for level in levels:
            columns[name_of(column, level)] = (words == level).astype(np.float64)
            if not level:
                columns[name_of(column, level)] = np.array([word.lower() in HOLES for word in words], float)
        if levels != [""]:
            report_unknown(Counter(word for word in words.tolist() if word not in levels), column)
    return columns


def report_unknown(unknown: Mapping[str, int], column: str) -> None:
    """Log a warning about levels that the model does not know; do nothing if `unknown` is empty."""
    if unknown:
        _log.warning(
            "tabular: %d rows have levels in the column %s that the training table does not have, such as %s; they "
            "are read as none of the known levels.",
            sum(unknown.values()),
            quote(column),
            quote(next(iter(unknown))),
        )


def count_levels(cells: Columns, name: str) -> int:
    """Return the number of different words of a column, without the words that mean a missing cell."""
    return len(_levels(cells, name))


def _levels(cells: Columns, name: str) -> Counter[str]:
    """Return the words of a column that are not missing, with their numbers of rows."""
    return Counter(word for word in cells.cells[name] if word.lower() not in cells.notation.missing)


def _indicator(words: Sequence[str], level: str, missing: Collection[str] = ()) -> list[str]:
    """Return 1 for each cell that holds the level, and 0 for others; for the empty level, 1 for each missing cell."""
    if not level:
        return ["1" if word.lower() in missing else "0" for word in words]
    return ["1" if word == level else "0" for word in words]
