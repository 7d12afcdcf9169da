"""Data set of a user's own table; framework.data describes the contract."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.configuration.paths import FilePath, Words
from framework.data import Batch, Data, Preprocessing, Splits
from framework.datasets.csv_columns import LabelledWriting
from framework.errors import DataError, quote
from plugins.data.tabular.picture import bars
from plugins.data.tabular.table import (
    Arrange,
    InputColumns,
    Kind,
    Missing,
    Question,
    Standardise,
    Table,
    WordColumns,
    from_memory,
    load,
    read,
    restore_columns,
)

Share = Annotated[float, Field(gt=0, lt=1, allow_inf_nan=False)]
TestShare = Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)]


class Tabular(Data):
    """A user's own CSV table: columns of numbers are the input, and one column (or several of one kind) is the target.

    Inputs are standardised by the mean and standard deviation of the training rows; a column that is constant in these
    rows becomes 0. Targets keep their own unit, but degrees become radians. Batches also hold "line", the line number
    of the row in the file. A column `split` assigns each row to train, validation or test. A column `group` names the
    groups for which results are also reported separately.

    Args:
        path: The CSV file.
        target: The column to predict, or several columns if they hold numbers.
        kind: Kind of the target: a class label, a real number, or an angle in degrees or radians.
        columns: Columns of the input; None for every other column whose cells are mostly numbers.
        validation: Share of the rows for validation, chosen at random, if there is no column `split`. If this column
            names no row for validation, it is the share of the training rows that is used for validation.
        test: Share of the rows for the test, chosen at random, if there is no column `split`; 1 makes all rows of a
            table test rows, for a model that was trained on another table.
        data_seed: Seed of the choice of these rows, independent of the seed of the run.
        missing: Treatment of rows without a number or a label. "error" refuses them, "skip" leaves them out. "median"
            fills missing inputs with the median of the training rows, and leaves out rows without a target. For each
            column with missing numbers in the training rows, it adds a column `name=`, which is 1 where a number of the
            column `name` is missing.
        small_angles: Whether angles in degrees may all lie within ±2π; by default this is refused, because such angles
            look like radians.
        words: Treatment of columns of words. "leave_out" does not read them; "levels" reads a column of 0 and 1 for
            each of up to 50 different words. A word that does not occur in the training table is read as 0 in all these
            columns.
        writing: Notation of the file, and of further files for prediction: separator, decimal sign and the like.
    """

    bibtex = "tabular"
    synthetic = False
    suffixes = (".csv",)
    varies = False

    # More than eight parameters: each keyword is a config key that a user sets alone.
    def __init__(
        self,
        *,
        path: FilePath | None = None,
        target: Words | list[Words] = "target",
        kind: Kind = "class",
        columns: list[Words] | None = None,
        validation: Share = 0.15,
        test: TestShare = 0.15,
        data_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0,
        missing: Missing = "error",
        small_angles: bool = False,
        words: WordColumns = "leave_out",
        writing: LabelledWriting,
    ) -> None:
        names = (target,) if isinstance(target, str) else tuple(dict.fromkeys(target))
        chosen = None if columns is None else tuple(columns)
        self.path = path
        self._trained: InputColumns | None = None
        self.small_angles = small_angles
        self.words: WordColumns = words
        self.writing = writing
        self.question = Question(names, kind, chosen, validation, test, data_seed, missing)

    def prepare(self) -> None:
        table = self._table
        self.target = table.target
        self.columns = table.inputs.names
        self.input_shape = (len(self.columns),)
        self.plane = len(self.columns) == 2
        self.groups = table.groups
        self.title = Path(self.path or "").stem
        self.skipped = table.skipped
        names = ", ".join(map(quote, self.question.target))
        column = "column" if len(self.question.target) == 1 else "columns"
        self.remarks = (f"predicted: the {column} {names}, data.kind={self.question.kind}", *table.remarks)

    @cached_property
    def _table(self) -> Table:
        if self.path is None:
            raise DataError("data.path is not set. Set data.path to the CSV file that holds your table.")
        question = self.question
        if not question.target or (question.kind == "class" and len(question.target) > 1):
            raise DataError(
                f"data.target = {list(question.target)} does not fit data.kind={question.kind}. Name one column, or "
                "several columns if the kind is real, degrees or radians."
            )
        if self.small_angles and question.kind != "degrees":
            raise DataError(
                f"data.small_angles=true has no effect with data.kind={question.kind}. Leave data.small_angles out, or "
                "set data.kind=degrees."
            )
        if question.test < 1 <= question.validation + question.test:
            raise DataError(
                f"data.validation + data.test = {question.validation + question.test:g}, but the sum must be less than "
                "1 to leave rows for training. Reduce one of them."
            )
        file = Path(self.path).expanduser()
        return load(
            file,
            question,
            self._trained,
            self.writing,
            small_angles=self.small_angles,
            words=self.words,
            arrange=self._arrange,
        )

    _arrange: Arrange | None = None
    """Function that changes cells and settings after the table is read; a subclass may set it."""

    def check_files(self) -> None:
        _ = self._table

    def splits(self) -> Splits:
        return self._table.splits

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return read(files, self._input_columns, self.writing)

    def inputs(self, user_data: Any) -> Tensor:
        """Return standardised inputs (row, column) from a CSV file, a DataFrame, a mapping by column, or an array."""
        if isinstance(user_data, str | Path) or (
            isinstance(user_data, list) and isinstance(user_data[0], str | Path)
        ):
            return Data.inputs(self, user_data)
        return from_memory(user_data, self._input_columns)

    def preprocessing(self) -> Preprocessing:
        scaling, fill = self._input_columns.scaling, self._input_columns.fill
        largest, mean, deviation = (torch.from_numpy(np.asarray(part, np.float64)) for part in scaling)
        missing = None if fill is None else tuple(sorted(self.writing.missing))
        extent = self._input_columns.extent
        ranges = None if extent is None else torch.from_numpy(np.stack(extent))
        return Preprocessing(
            Standardise(scaling, fill), largest * mean, largest * deviation, missing, ranges=ranges
        )

    @property
    def _input_columns(self) -> InputColumns:
        # before training no columns are stored; the training table provides them
        return self._trained or self._table.inputs

    def state_dict(self) -> Mapping[str, Any]:
        names, scaling, labels, content, fill, extent = self._input_columns
        numbers = {name: array.tolist() for name, array in scaling._asdict().items()}
        # a model that an older version stored has neither labels nor the hash of a table
        optional = {"labels": list(labels)} if labels else {}
        optional |= {"content": content} if content else {}
        optional |= {} if fill is None else {"fill": fill.tolist()}
        optional |= {} if extent is None else {"low": extent[0].tolist(), "high": extent[1].tolist()}
        return {"columns": list(names), **numbers, **optional}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        if state:
            self._trained = restore_columns(state)

    def augment(self, batch: Batch) -> Batch:
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        table = self._table
        return {
            "root": str(self.path),
            "version": "tabular 1",
            **table.sizes,
            "columns": ", ".join(self.columns),
            "constant": ", ".join(table.constant) or "none",
            "sha256": table.digest,
        }

    def preview(self, inputs: Tensor) -> np.ndarray:
        return bars(inputs.detach().cpu().double().numpy())
