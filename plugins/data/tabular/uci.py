"""Regression data sets of the UCI repository, with the splits on which published results are compared."""

from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from framework.configuration.paths import FilePath
from framework.datasets.csv_columns import Columns, LabelledWriting
from framework.errors import DataError, quote
from plugins.data.tabular.data import Share, Tabular
from plugins.data.tabular.table import Question, Table

MARKS = "test_in_splits"
"""Name of the column whose cell has one character for each split: "T" if the row is a test row of that split."""


class UCI(Tabular):
    """A table of the UCI repository with standard splits (Hernández-Lobato & Adams 2015).

    The file `<set>.csv` in the folder `root` has columns of numbers, the target in the column before the last, and a
    last column `test_in_splits` with one character for each split, T if the row is a test row of this split. The rows
    that are not for the test are divided at random into training and validation rows. Inputs are standardised, and
    targets keep their own unit (`Tabular`).

    Args:
        root: The folder of the files.
        set: Name of the file, without its ending.
        split: Number of the split, from 0.
        validation: Share of the rows for validation, among those that are not for the test.
        data_seed: Seed of the choice of the validation rows.
    """

    bibtex = "hernandez2015probabilistic, gal2016dropout"

    def __init__(
        self,
        *,
        root: FilePath | None = None,
        set: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")] = "concrete",  # a config key
        split: Annotated[int, Field(ge=0)] = 0,
        validation: Share = 0.1,
        data_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0,
    ) -> None:
        super().__init__(kind="real", validation=validation, data_seed=data_seed, writing=LabelledWriting())
        self.root = root
        self.set = set
        self.split = split
        self._arrange = self._assign_splits

    @cached_property
    def _table(self) -> Table:
        if self.root is None:
            raise DataError(f"data.root is not set. Set data.root to the folder that holds {self.set}.csv.")
        self.path = str(Path(self.root).expanduser() / f"{self.set}.csv")
        return super()._table

    def _assign_splits(self, cells: Columns, question: Question) -> tuple[Columns, Question]:
        """Return the cells with a column `split` in place of `test_in_splits`, and settings that name the target."""
        names = list(cells.cells)
        if len(names) < 3 or names[-1] != MARKS:
            raise DataError(
                f"{cells.file} has the columns {quote(', '.join(names))}, but columns of numbers, the target and "
                f"{MARKS!r} as the last one are expected. Give a file of this form, or use data=tabular."
            )
        marks = cells.cells[MARKS]
        bad = [row for row, mark in enumerate(marks) if len(mark) <= self.split or set(mark) - {"T", "."}]
        if bad:
            raise DataError(
                f"{cells.file} line {cells.lines[bad[0]]}, column {MARKS!r}: {quote(marks[bad[0]])} does not say with "
                f"a T or a point whether the row is a test row of split {self.split}. Correct the cell, or set "
                f"data.split below {min(map(len, marks))}."
            )
        self.question = question._replace(target=(names[-2],))
        words = np.array(["test" if mark[self.split] == "T" else "train" for mark in marks], dtype=object)
        others = np.flatnonzero(words == "train")
        chosen = np.random.default_rng(self.question.data_seed).permutation(others)
        words[chosen[: round(self.question.validation * len(others))]] = "validation"
        columns = {name: column for name, column in cells.cells.items() if name != MARKS}
        return replace(cells, cells={**columns, "split": words.tolist()}), self.question
