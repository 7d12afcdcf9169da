"""Data set of a user's own table; framework.data describes the contract."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.configuration.paths import FilePath, Words
from framework.data import Batch, Data, Splits
from framework.datasets.csv_columns import LabelledWriting
from framework.errors import DataError, quote
from plugins.data.tabular.picture import bars
from plugins.data.tabular.table import (
    Kind,
    Missing,
    Question,
    Reading,
    Table,
    load,
    of_rows,
    read,
    stored_reading,
)

Share = Annotated[float, Field(gt=0, lt=1, allow_inf_nan=False)]


class Tabular(Data):
    """Your own CSV table: columns of numbers are the input, one column (or several of one kind) is predicted.

    Inputs are standardised by the mean and standard deviation of the training rows; a column that is constant there
    becomes 0. Targets keep their own unit; degrees become radians. Batches also hold "line", the row's line number in
    the file. A column `split` assigns each row to train, validation or test. A column `group` names the groups for
    which results are also reported separately.

    Args:
        path: the CSV file.
        target: the column to predict, or several columns where they are numbers.
        kind: kind of the target: a class label, a real number, or an angle in degrees or radians.
        columns: columns of the input; None for every other column most of whose cells are numbers.
        validation: share of the rows for validation, drawn at random, where there is no column `split`.
        test: share of the rows for the test, likewise.
        data_seed: seed of that draw; it does not depend on the seed of the run.
        missing: treatment of rows with an empty cell where a number or a label is wanted: refuse or skip.
        small_angles: whether angles in degrees may all lie within ±2π; by default this is refused, because such angles
            look like radians.
        writing: how the file, and others like it, are written.
    """

    bibtex = """@misc{tabular,
  title = {A table of the user's own},
  note = {Cite the source of this table}
}"""
    synthetic = False
    suffixes = (".csv",)
    varies = False

    def __init__(
        self,
        *,
        path: FilePath | None = None,
        target: Words | list[Words] = "target",
        kind: Kind = "class",
        columns: list[Words] | None = None,
        validation: Share = 0.15,
        test: Share = 0.15,
        data_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0,
        missing: Missing = "error",
        small_angles: bool = False,
        writing: LabelledWriting,
    ) -> None:
        names = (target,) if isinstance(target, str) else tuple(dict.fromkeys(target))
        chosen = None if columns is None else tuple(columns)
        self.path = path
        self._trained: Reading | None = None
        self.small_angles = small_angles
        self.writing = writing
        self.question = Question(names, kind, chosen, validation, test, data_seed, missing)

    def prepare(self) -> None:
        table = self._table
        self.target = table.target
        self.columns = table.reading.columns
        self.input_shape = (len(self.columns),)
        self.plane = len(self.columns) == 2
        self.groups = table.groups
        self.title = Path(self.path or "").stem
        self.skipped = table.skipped
        names = ", ".join(map(quote, self.question.target))
        self.remarks = (f"predicted: the column {names}, data.kind={self.question.kind}", *table.remarks)

    @cached_property
    def _table(self) -> Table:
        if self.path is None:
            raise DataError("data.path is not set; wanted the CSV file that holds your table.")
        asked = self.question
        if not asked.target or (asked.kind == "class" and len(asked.target) > 1):
            raise DataError(
                f"data.target = {list(asked.target)} with data.kind={asked.kind}: wanted one column, or several where "
                "the kind is real or degrees."
            )
        if self.small_angles and asked.kind != "degrees":
            raise DataError(
                f"data.small_angles=true changes nothing with data.kind={asked.kind}; wanted it with "
                "data.kind=degrees. Leave it out."
            )
        if asked.validation + asked.test >= 1:
            raise DataError(
                f"data.validation + data.test = {asked.validation + asked.test:g}: wanted less than 1, so that rows "
                "are left for training."
            )
        file = Path(self.path).expanduser()
        return load(file, asked, self._trained, self.writing, small_angles=self.small_angles)

    def check_files(self) -> None:
        _ = self._table

    def splits(self) -> Splits:
        return self._table.splits

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return read(files, self._reading, self.writing)

    def inputs(self, user_data: Any) -> Tensor:
        """Return standardised inputs (row, column) from a CSV file, a DataFrame, a mapping by column, or an array."""
        if isinstance(user_data, str | Path) or (
            isinstance(user_data, list) and isinstance(user_data[0], str | Path)
        ):
            return Data.inputs(self, user_data)
        return of_rows(user_data, self._reading)

    @property
    def _reading(self) -> Reading:
        # without a stored reading, as before training, the reading comes from the training table
        return self._trained or self._table.reading

    def state_dict(self) -> Mapping[str, Any]:
        columns, scaling = self._reading
        numbers = {name: array.tolist() for name, array in scaling._asdict().items()}
        return {"columns": list(columns), **numbers}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        if state:
            self._trained = stored_reading(state)

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
