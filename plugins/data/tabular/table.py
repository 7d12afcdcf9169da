"""Conversion of a user's CSV table to tensors: choice of columns, rows and splits."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from framework.data import Splits, as_inputs
from framework.datasets.angles import unlike_degrees, unlike_radians
from framework.datasets.class_names import compare_classes, describe_dominant
from framework.datasets.csv_columns import (
    ColumnChoice,
    Columns,
    LabelledWriting,
    Writing,
    describe_choice,
    describe_words,
    is_boolean,
    number,
    numbers,
    numeric_columns,
    read_columns,
    require,
    tables,
)
from framework.datasets.fields import Fields
from framework.datasets.file_columns import refuse_other_split, suggest_split
from framework.distributions.circular import wrap
from framework.errors import DataError, did_you_mean, quote, shorten
from framework.storage import text
from framework.storage.arrays import to_real
from framework.target import Target
from plugins.data.tabular.levels import (
    MOST_LEVELS,
    add_levels,
    count_levels,
    expand_words,
    explain_many_levels,
    levels_in_memory,
    name_of,
)
from plugins.data.tabular.remarks import (
    Extent,
    describe_copies,
    describe_far_rows,
    describe_untested,
    report_far,
)

Kind = Literal["class", "real", "degrees", "radians"]
Missing = Literal["error", "skip", "median"]
WordColumns = Literal["leave_out", "levels"]
SPLITS = Splits._fields
SPLIT, GROUP = "split", "group"
MANY_LABELS = 20
"""Number of different numeric labels that are always accepted as classes.

More are refused if some of them are fractions, or if they are more than half of the number of rows.
"""


class Question(NamedTuple):
    """Settings that determine how a table is read, from the arguments of `Tabular`.

    Attributes:
        target: Columns to predict.
        kind: Kind of the target: class, real number or angle.
        columns: Columns of the input; None for every other column whose cells are mostly numbers.
        validation, test: Shares of the rows for these splits, if there is no column `split`.
        data_seed: Seed of the random splits.
        missing: Treatment of rows without a number or a label. "error" refuses them, "skip" leaves them out, "median"
            fills missing inputs and leaves out rows without a target.
    """

    target: tuple[str, ...]
    kind: Kind
    columns: tuple[str, ...] | None
    validation: float
    test: float
    data_seed: int
    missing: Missing


Arrange = Callable[[Columns, Question], tuple[Columns, Question]]
"""Function that changes the cells of a table after they are read, and the settings of the data set."""


class Scaling(NamedTuple):
    """Scaling of each column x to (x / largest - mean) / deviation.

    Values are divided by `largest` first, so that no square overflows.

    Attributes:
        largest: Largest absolute value of each column.
        mean: Mean of each column after this division.
        deviation: Standard deviation of each column after this division.
    """

    largest: Float[np.ndarray, "column"]
    mean: Float[np.ndarray, "column"]
    deviation: Float[np.ndarray, "column"]


class InputColumns(NamedTuple):
    """Columns that are the input, and what else a model keeps of its training table.

    Attributes:
        names: Names of the columns.
        scaling: Scaling of the columns.
        labels: Classes of the target; () for a target of another kind, or if an older version stored the model.
        content: Hash of the cells of the training table; "" if an older version stored the model.
        fill: Median of each column in the training rows, which replaces missing numbers; None if none may be missing.
        extent: Smallest and largest number of each column in the training rows; None if an older version stored the
            model.
    """

    names: tuple[str, ...]
    scaling: Scaling
    labels: tuple[str, ...] = ()
    content: str = ""
    fill: Float[np.ndarray, "column"] | None = None
    extent: Extent | None = None


FILL = "data.missing=median"


def restore_columns(state: Mapping[str, Any]) -> InputColumns:
    """Return the input columns of a model's training data from the state in a checkpoint.

    Raises:
        DataError: The state does not hold finite numbers for each column, or a column would be divided by 0.
    """
    names: Sequence[Any] = state["columns"] if isinstance(state.get("columns"), list | tuple) else ()
    labels: Sequence[Any] = state.get("labels", ())
    content = state.get("content", "")
    are_names = bool(names) and all(isinstance(name, str) for name in names)
    are_names &= isinstance(labels, list | tuple) and all(isinstance(label, str) for label in labels)
    are_names &= isinstance(content, str)
    fill = extent = None
    try:
        scaling = Scaling(*(np.array(state[name], np.float64) for name in Scaling._fields))
        fill = np.array(state["fill"], np.float64) if "fill" in state else None
        if "low" in state:
            extent = np.array(state["low"], np.float64), np.array(state["high"], np.float64)
    except (KeyError, TypeError, ValueError):
        scaling = Scaling(*(np.zeros(0) for _ in Scaling._fields))
    if (
        not are_names
        or any(
            part.shape != (len(names),) or not np.isfinite(part).all()
            for part in (*scaling, *([] if fill is None else [fill]), *(extent or ()))
        )
        or (scaling.largest <= 0).any()
        or (scaling.deviation <= 0).any()
    ):
        raise DataError(
            f"The stored state of tabular must hold {', '.join(Scaling._fields)} of each input column, but holds "
            "something else. Load another checkpoint, or train the model again."
        )
    return InputColumns(tuple(names), scaling, tuple(labels), content, fill, extent)


class Table(NamedTuple):
    """Content of a table.

    Attributes:
        target: Description of the target.
        inputs: The input columns.
        constant: Names of the input columns that are constant in the training rows.
        groups: Names of the groups.
        splits: The three splits.
        sizes: Number of samples of each split, by its name.
        skipped: Number of rows that were left out.
        digest: Hash of the cells and of the settings.
        remarks: Clauses about columns that were left out or look odd.
    """

    target: Target
    inputs: InputColumns
    constant: tuple[str, ...]
    groups: tuple[str, ...]
    splits: Splits
    sizes: dict[str, str]
    skipped: int
    digest: str
    remarks: tuple[str, ...]


def load(
    file: Path,
    question: Question,
    trained: InputColumns | None = None,
    writing: Writing | None = None,
    *,
    small_angles: bool = False,
    words: WordColumns = "leave_out",
    arrange: Arrange | None = None,
) -> Table:
    """Read, check, split and standardise a table.

    Args:
        file: The CSV file.
        question: The settings of the data set.
        trained: Input columns of a trained model; None to fit the scaling to the training rows of this table.
        writing: Notation of the file; None for the default.
        small_angles: Whether angles in degrees may all lie within ±2π.
        words: Treatment of columns of words.
        arrange: Function that changes cells and settings after the table is read; it may, for example, add a column
            `split`.

    Raises:
        DataError: The file, a column, a cell, a label or a split has a fault; the message names line and column.
    """
    cells = read_columns(file, writing or LabelledWriting())
    cells, question = (cells, question) if arrange is None else arrange(cells, question)
    require(cells, question.target, "data.target")
    if question.test < 1:
        refuse_other_split(cells, question.target)
    content = hashlib.sha256(repr(cells.cells).encode()).hexdigest()
    digest = hashlib.sha256(repr((content, question)).encode()).hexdigest()
    if trained is not None:
        cells = add_levels(cells, trained.names)
    elif words == "levels":
        cells, levels = expand_words(cells, (*question.target, SPLIT, GROUP))
        if question.columns is not None:
            names = [part for name in question.columns for part in levels.get(name, (name,))]
            question = question._replace(columns=tuple(names))
    choice = (
        _choose_inputs(cells, question, words) if trained is None else _choose(cells, question, trained.names)
    )
    if words == "levels":
        choice = choice._replace(left_out=explain_many_levels(cells, choice.left_out))
    columns = choice.names
    require(cells, columns, "The trained model")
    fills = question.missing == "median"
    if fills and trained is not None and trained.fill is None:
        raise DataError(
            f"{FILL} fills missing numbers with the medians of the training rows, but the model was trained without "
            "this setting and stores no medians. Leave it out, or train the model again with it."
        )
    skip_remedy = "set data.missing=skip to leave such rows out" if question.missing == "error" else None
    fill_remedy = (
        None
        if skip_remedy is None
        else f"set {FILL} to fill in the median of the training rows, or {skip_remedy}"
    )
    inputs = np.stack([numbers(cells, name, missing=fill_remedy, booleans=True) for name in columns], -1)
    values, absent = _targets(cells, question, skip_remedy)
    _check_unit(cells, question, values, small_angles=small_angles)
    complete = ~absent if fills else ~(np.isnan(inputs).any(-1) | absent)
    rows = np.flatnonzero(complete)
    groups, group = _groups(file, cells, rows)
    split, remarks = _splits(cells, rows, values, question, trained, content)
    training = rows[split == 0]
    fitted_rows = (
        training if len(training) else rows
    )  # a table for the test of a trained model has no training rows
    fill = None
    if fills:
        remarks += _describe_holes(columns, inputs[rows])
        if trained is None:
            columns, inputs, fill = _mark_holes(cells, columns, inputs, fitted_rows)
        else:
            fill = trained.fill
    inputs = fill_missing(inputs, fill)
    scaling, constant = fit_scaling(inputs[fitted_rows])
    scaling = scaling if trained is None else trained.scaling
    extent = inputs[fitted_rows].min(0), inputs[fitted_rows].max(0)
    if trained is None:
        remarks += describe_copies(inputs[rows], values[rows], split, [cells.lines[row] for row in rows])
    else:
        extent = trained.extent
        remarks += describe_far_rows(columns, inputs[rows], extent)
    labels = () if trained is None else trained.labels
    target, encoded = _encode(cells, rows, fitted_rows, values, question, labels)
    if target.kind == "class" and trained is None:
        remarks += compare_classes(target.names, f"{file}, column {question.target[0]!r}")
        remarks += describe_untested(target.names, values[rows], split)
    if target.kind == "class":
        remarks += describe_dominant(target.names, encoded[torch.from_numpy(split == 2)].numpy())
    if target.kind == "real" and trained is None:
        remarks += _constant_targets(question.target, values[training])
    scaled = as_float32(cells, columns, rows, standardise(inputs[rows], scaling))
    lines = torch.tensor(cells.lines)[torch.from_numpy(rows)]
    parts = {}
    for split_index, name in enumerate(SPLITS):
        chosen = torch.from_numpy(split == split_index)
        parts[name] = Fields(
            input=scaled[chosen],
            target=encoded[chosen],
            group=group[chosen],
            line=lines[chosen],
            index=torch.arange(int(chosen.sum())),
        )
    sizes = {name: str(len(part)) for name, part in parts.items()}
    constant_names = tuple(
        name for name, is_constant in zip(columns, constant.tolist(), strict=True) if is_constant
    )
    return Table(
        target,
        InputColumns(columns, scaling, target.names if target.kind == "class" else (), content, fill, extent),
        constant_names,
        groups,
        Splits(**parts),
        sizes,
        len(complete) - len(rows),
        digest,
        (*describe_choice(choice), *remarks),
    )


def read(files: Sequence[Path], columns: InputColumns, writing: Writing | None = None) -> Fields:
    """Return the input columns of further files with the scaling of the training rows, one sample for each row.

    Raises:
        DataError: There is no file, a file cannot be read or lacks a column, or a cell is not a finite number.
    """
    parts = []
    notation, setting = writing or LabelledWriting(), "The trained model"
    arrange = partial(add_levels, names=columns.names)
    remedy = None if columns.fill is not None else f"train the model with {FILL}, which fills such cells"
    for cells, inputs in tables(files, columns.names, setting, notation, arrange, remedy):
        inputs = fill_missing(inputs, columns.fill)
        report_far(columns.names, inputs, columns.extent)
        rows = np.arange(len(inputs))
        parts.append(as_float32(cells, columns.names, rows, standardise(inputs, columns.scaling)))
    inputs = torch.cat(parts)
    return Fields(input=inputs, index=torch.arange(len(inputs)))


def from_memory(user_data: Any, columns: InputColumns) -> Float[Tensor, "row column"]:
    """Return standardised inputs from rows in memory: a DataFrame, a mapping by column, or an array in column order.

    If the model fills missing numbers, these are NaN or None, and an array may lack the columns that mark them.

    Raises:
        DataError: A column is missing, a cell is not a finite number, or an array has another number of columns.
    """
    if hasattr(user_data, "columns") or isinstance(user_data, Mapping):
        levels = levels_in_memory(user_data, columns.names)
        missing = [name for name in columns.names if name not in user_data and name not in levels]
        if missing:
            raise DataError(
                f"The model reads the column {missing[0]!r}, which the data do not "
                f"have.{did_you_mean(missing[0], user_data)} It reads the columns {', '.join(columns.names)}."
            )
        parts = [levels[name] if name in levels else user_data[name] for name in columns.names]
        user_data = np.stack([np.atleast_1d(np.asarray(part)) for part in parts], -1)
    try:
        rows = to_real(user_data, "the input")
    except (TypeError, ValueError) as error:
        raise DataError(
            f"The input cannot be read as rows of numbers: {str(error)[:200]}. Give rows of numbers, in the columns "
            f"{', '.join(columns.names)}."
        ) from error
    rows = as_inputs(_add_marks(rows, columns), (len(columns.names),)).numpy()
    rows = fill_missing(rows, columns.fill)
    scaled = standardise(rows, columns.scaling)
    wrong = np.argwhere(~(np.abs(scaled) <= np.finfo(np.float32).max))
    if len(wrong):
        row, column = wrong[0]
        raise DataError(
            f"Row {row}, column {columns.names[column]!r}: {rows[row, column]} is not a finite number within single "
            "precision. Correct the number, or leave the row out."
            + (
                f" A model that is trained with {FILL} fills missing numbers."
                if np.isnan(rows[row, column])
                else ""
            )
        )
    report_far(columns.names, rows, columns.extent)
    return torch.from_numpy(scaled.astype(np.float32))


class Standardise(nn.Module):
    """Standardisation of rows for an exported model: each number minus its column's mean, in standard deviations."""

    largest: Tensor
    mean: Tensor
    deviation: Tensor
    fill: Tensor | None

    def __init__(self, scaling: Scaling, fill: np.ndarray | None = None) -> None:
        super().__init__()
        self.register_buffer("fill", None if fill is None else torch.from_numpy(fill))
        for name, part in zip(Scaling._fields, scaling, strict=True):
            self.register_buffer(name, torch.from_numpy(np.asarray(part, np.float64)))

    def forward(self, rows: Tensor) -> Tensor:
        """Return standardised rows, float32, for rows in their own units, float64, in which `fill` replaces NaN."""
        if self.fill is not None:
            rows = torch.where(rows.isnan(), self.fill, rows)
        return ((rows / self.largest - self.mean) / self.deviation).float()


def fill_missing(
    inputs: Float[np.ndarray, "row column"], fill: Float[np.ndarray, "column"] | None
) -> Float[np.ndarray, "row column"]:
    """Return the inputs with `fill` in place of NaN; unchanged if there is no `fill`."""
    return inputs if fill is None else np.where(np.isnan(inputs), fill, inputs)


def _mark_holes(
    cells: Columns, columns: tuple[str, ...], inputs: np.ndarray, training: np.ndarray
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Return columns and inputs with a mark of missing numbers for each column that needs one, and the medians.

    The mark of a column is a further column, `name=`, which is 1 where a number is missing, and 0 elsewhere. A column
    needs one if numbers are missing in the training rows.

    Args:
        cells: The table.
        columns: Names of the input columns.
        inputs: Inputs (row, column), NaN where a number is missing.
        training: Indices of the training rows.

    Raises:
        DataError: A column has no number in the training rows.
    """
    holes = np.isnan(inputs)
    empty = holes[training].all(0)
    if empty.any():
        name = columns[int(empty.argmax())]
        raise DataError(
            f"{cells.file}, column {name!r}: No training row has a number, so that there is no median for {FILL}. "
            "Leave the column out by data.columns, or add rows."
        )
    marked = [
        index
        for index, name in enumerate(columns)
        if holes[training, index].any() and name_of(name, "") not in cells.cells
    ]
    fill = np.concatenate([np.nanmedian(inputs[training], axis=0), np.zeros(len(marked))])
    names = (*columns, *(name_of(columns[index], "") for index in marked))
    return names, np.concatenate([inputs, holes[:, marked]], -1), fill


def _add_marks(rows: np.ndarray, columns: InputColumns) -> np.ndarray:
    """Return an array of rows with the columns that mark missing numbers, if it has all columns but these."""
    plain = [name for name in columns.names if not (name.endswith("=") and name[:-1] in columns.names)]
    if columns.fill is None or rows.ndim not in (1, 2) or rows.shape[-1] != len(plain):
        return rows
    parts = {name: rows[..., index] for index, name in enumerate(plain)}
    return np.stack(
        [parts[name] if name in parts else np.isnan(parts[name[:-1]]) for name in columns.names], -1
    )


def _describe_holes(columns: Sequence[str], inputs: np.ndarray) -> tuple[str, ...]:
    """Return a remark with the number of missing inputs that are filled, by column."""
    counts = np.isnan(inputs).sum(0).tolist()
    listed = [f"{quote(name)} ({count})" for name, count in zip(columns, counts, strict=True) if count]
    if not listed:
        return ()
    return (
        f"missing numbers, which are filled with the median of the training rows: {shorten(', '.join(listed), 200)}",
    )


def fit_scaling(inputs: Float[np.ndarray, "row column"]) -> tuple[Scaling, np.ndarray]:
    """Return the scaling to mean 0 and standard deviation 1, and a mask (column,) of the constant columns.

    Constant columns are scaled to 0.
    """
    constant = inputs.max(0) == inputs.min(0)
    largest = np.where(constant, 1.0, np.abs(inputs).max(0))
    shrunk = inputs / largest
    mean = np.where(constant, inputs[0], shrunk.mean(0))
    deviation = np.where(constant, 1.0, np.sqrt(np.square(shrunk - mean).mean(0)))
    return Scaling(largest, mean, deviation), constant


def standardise(inputs: Float[np.ndarray, "row column"], scaling: Scaling) -> Float[np.ndarray, "row column"]:
    """Return each column as its distance from the mean, in standard deviations."""
    with np.errstate(over="ignore"):  # as_float32 refuses an infinite result and names its line and column
        return (inputs / scaling.largest - scaling.mean) / scaling.deviation


def as_float32(
    cells: Columns,
    columns: Sequence[str],
    rows: Int[np.ndarray, "row"],
    values: Float[np.ndarray, "row column"],
) -> Float[Tensor, "row column"]:
    """Return the values in single precision.

    Args:
        cells: The table from which the values come, for the message.
        columns: Name of each column of `values`.
        rows: Index in the table of each row of `values`.
        values: The values.

    Raises:
        DataError: A number is too large for single precision; the message names line and column.
    """
    with np.errstate(over="ignore"):
        narrow = values.astype(np.float32)
    wrong = np.argwhere(~np.isfinite(narrow))
    if len(wrong):
        row, name = rows[wrong[0, 0]], columns[int(wrong[0, 1])]
        raise DataError(
            f"{cells.file} line {cells.lines[row]}, column {name!r}: {cells.cells[name][row]!r} lies beyond "
            "single precision (3.4e38), either unscaled or in standard deviations of the training rows. Correct the "
            "cell, or change the unit."
        )
    return torch.from_numpy(narrow)


def _choose_inputs(cells: Columns, question: Question, words: WordColumns) -> ColumnChoice:
    """Return the input columns: those that the settings name, or all columns of numbers."""
    if question.columns is not None:
        require(cells, question.columns, "data.columns")
        columns = tuple(dict.fromkeys(question.columns))
        known = set(columns) & set(question.target)
        if known:
            raise DataError(
                f"data.columns names {min(known)!r}, but this column is the target (data.target). Remove it from "
                "data.columns."
            )
        for name in columns:
            _require_numbers(cells, name, words)
        chosen = _choose(cells, question, columns)
    else:
        chosen = numeric_columns(cells, (*question.target, SPLIT, GROUP), "data.columns")
    if not chosen.names:
        raise DataError(
            f"{cells.file} has no column of numbers besides {', '.join(question.target)}. Its columns are "
            f"{shorten(', '.join(cells.cells))}. Name input columns in data.columns."
            + "".join(f" {quote(name)}: {why}." for name, why in list(chosen.left_out.items())[:8])
        )
    return chosen


def _require_numbers(cells: Columns, name: str, words: WordColumns) -> None:
    """Raise an error if an input column that the settings name holds words or dates.

    Args:
        cells: The table.
        name: Name of the column.
        words: Setting of the columns of words; with "levels", only columns that it cannot read are still words.
    """
    kind = describe_words(cells, name)
    if not kind:
        return
    count = count_levels(cells, name)
    if kind.startswith("dates"):
        advice = "Write numbers into the column, such as days since the first date"
    elif words == "levels" or count > MOST_LEVELS:
        advice = (
            f"It has {count} different words, but data.words=levels reads 2 to {MOST_LEVELS}. Give rare words a common "
            "name"
        )
    else:
        advice = "To read words, set data.words=levels"
    raise DataError(
        f"{cells.file}, column {quote(name)}: data.columns names the column, but it holds {kind}, and inputs are "
        f"numbers. {advice}, or remove the column from data.columns."
    )


def _choose(cells: Columns, question: Question, columns: tuple[str, ...]) -> ColumnChoice:
    """Return the choice of `columns` as input, with a reason for each column that is not read."""
    known = (*columns, *question.target, SPLIT, GROUP)
    unread = [name for name in cells.cells if name not in known]
    left_out = dict(cells.left_out) | dict.fromkeys(unread, "not among the columns to read")
    return ColumnChoice(columns, left_out, {})


def _targets(cells: Columns, question: Question, skip_remedy: str | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the targets as they are in the table, and a mask (row,) of the rows without a target.

    Targets are labels (row,) if the kind is "class", and otherwise numbers (row, name) in the unit of the table.

    Args:
        cells: The table.
        question: The settings of the data set.
        skip_remedy: End of the message about a row without a target; None if such rows are left out.
    """
    if question.kind != "class":
        for name in question.target:
            if is_boolean(cells, name):
                raise DataError(
                    f"{cells.file}, column {name!r}: The column holds only TRUE and FALSE, but "
                    f"data.kind={question.kind} requires numbers. Set data.kind=class, or name another data.target."
                )
            if words := describe_words(cells, name):
                raise DataError(
                    f"{cells.file}, column {name!r}: The column holds {words}, but data.kind={question.kind} requires "
                    "numbers. To predict the words as classes, use experiment=tabular/classification, or set "
                    "data.kind=class and a density head for classes. To predict numbers, write numbers into the "
                    "column, or name another data.target."
                )
        values = np.stack([numbers(cells, name, missing=skip_remedy) for name in question.target], -1)
        return values, np.asarray(np.isnan(values).any(-1))
    name = question.target[0]
    labels = cells.cells[name]
    absent = np.array([label.lower() in cells.notation.missing for label in labels])
    if skip_remedy is not None and absent.any():
        row = int(absent.argmax())
        label = labels[row]
        fault = f"{label!r} means that there is no label" if label else "The label is missing"
        hint = f" If {label!r} is a label, set data.missing_words=[]." if label else ""
        raise DataError(
            f"{cells.file} line {cells.lines[row]}, column {name!r}: {fault}. Write a label, or {skip_remedy}.{hint}"
        )
    return np.array(labels, dtype=object), absent


def _check_unit(cells: Columns, question: Question, values: np.ndarray, *, small_angles: bool) -> None:
    """Refuse angles that seem to be in another unit than the configured one, degrees or radians.

    Raises:
        DataError: The angles seem to be in the other unit; the message names the setting to change.
    """
    if question.kind not in ("degrees", "radians"):
        return
    for name, column in zip(question.target, values.T, strict=True):
        if question.kind == "radians":
            wrong = unlike_radians(column)
            remedy = "Set data.kind=degrees, or wrap the angles to one turn."
        else:
            wrong = "" if small_angles else unlike_degrees(column)
            remedy = "Set data.kind=radians, or data.small_angles=true if the angles are in degrees."
        if wrong:
            raise DataError(f"{cells.file}, column {name!r}: {wrong}. {remedy}")


def _groups(file: Path, cells: Columns, rows: np.ndarray) -> tuple[tuple[str, ...], Int[Tensor, "row"]]:
    """Return the names of the groups, and the index of the group of each row."""
    if GROUP not in cells.cells:
        return (file.stem,), torch.zeros(len(rows), dtype=torch.int64)
    words = [cells.cells[GROUP][row] for row in rows]
    absent = [index for index, word in enumerate(words) if word.lower() in cells.notation.missing]
    if absent:
        word = words[absent[0]]
        fault = f"{word!r} means that there is no name" if word else "The name is missing"
        raise DataError(
            f"{cells.file} line {cells.lines[rows[absent[0]]]}, column `{GROUP}`: {fault}. "
            "Write a name in every row, or rename the column."
            + (f" If {word!r} is a name, set data.missing_words=[]." if word else "")
        )
    groups = sorted(set(words), key=_order)
    indices = {name: index for index, name in enumerate(groups)}
    return tuple(groups), torch.tensor([indices[word] for word in words], dtype=torch.int64)


def _splits(
    cells: Columns,
    rows: np.ndarray,
    values: np.ndarray,
    question: Question,
    trained: InputColumns | None,
    content: str,
) -> tuple[Int[np.ndarray, "row"], tuple[str, ...]]:
    """Return the split of each row, as an index into SPLITS, and remarks on the choice.

    The column `split` determines the split; without a row for validation, a share of the training rows is chosen.
    Without that column the rows are divided at random, but each class keeps a training row.

    Args:
        cells: The table.
        rows: Indices of the rows that are used.
        values: Targets of all rows.
        question: The settings of the data set.
        trained: Input columns of a trained model; None for a training. A table for the test of a trained model needs no
            rows of other splits.
        content: Hash of the cells.
    """
    random = np.random.default_rng(question.data_seed)
    remarks: tuple[str, ...] = ()
    if SPLIT in cells.cells:
        split = _stated_splits(cells, rows)
        if question.test == 1:
            raise DataError(
                f"data.test=1 has no effect, because the column `{SPLIT}` of {cells.file} assigns each row to a split. "
                "Leave data.test out."
            )
        training = np.flatnonzero(split == 0)
        if len(training) and not (split == 1).any():
            split[random.permutation(training)[: round(question.validation * len(training))]] = 1
            remarks = (
                f"the column `{SPLIT}` names no row for validation: {(split == 1).sum()} of {len(training)} training "
                f"rows are used for validation, because data.validation={question.validation:g}",
            )
        remedy = f"Assign rows to this split in the column `{SPLIT}`."
    elif question.test == 1:
        if trained is None or trained.content == content:
            which = "the model was trained on this table" if trained else "there is no trained model"
            raise DataError(
                f"{cells.file}: data.test=1 makes all rows test rows, but {which}. Leave data.test out, or use it with "
                "mode=test, checkpoint=<run folder> and another table."
            )
        split, remedy = np.full(len(rows), 2), "Add rows."
    else:
        split = np.zeros(len(rows), dtype=np.int64)
        order = random.permutation(len(rows))
        validation, test = (round(share * len(rows)) for share in (question.validation, question.test))
        split[order[:validation]] = 1
        split[order[validation : validation + test]] = 2
        is_other_table = trained is not None and trained.content not in ("", content)
        if question.kind == "class" and not is_other_table:
            remarks = _keep_training_rows(split, values[rows])
        if is_other_table:
            remarks = (
                f"{cells.file.name} is not the training table: {(split == 2).sum()} of its {len(rows)} rows, chosen at "
                "random, are the test split; data.test=1 makes all of them test rows",
            )
        remedy = f"Add rows, change data.validation and data.test, or add a column `{SPLIT}`."
    for index, name in enumerate(SPLITS):
        if not (split == index).any() and (trained is None or name == "test"):
            absent = len(cells.lines) - len(rows)
            without = f", {absent} are left out, because a number or a label is missing" if absent else ""
            raise DataError(
                f"{cells.file}: The {name} split is empty ({len(rows)} rows are used{without}). {remedy}"
            )
    return split, remarks


def _stated_splits(cells: Columns, rows: np.ndarray) -> Int[np.ndarray, "row"]:
    """Return the split of each row that is used, from the column `split`."""
    for row, word in enumerate(cells.cells[SPLIT]):
        if word not in SPLITS:
            raise DataError(
                f"{cells.file} line {cells.lines[row]}, column `{SPLIT}`: {word!r} is not a split. Write one of "
                f"{', '.join(SPLITS)}.{suggest_split(word)}"
            )
    return np.array([SPLITS.index(cells.cells[SPLIT][row]) for row in rows], dtype=np.int64)


def _keep_training_rows(split: Int[np.ndarray, "row"], labels: np.ndarray) -> tuple[str, ...]:
    """Move the first row of each class without a training row to the training split; return a remark about these rows.

    `split` is changed in place. Nothing is moved if the labels may not be meant as classes: more than two numbers, or
    very many words.
    """
    names = set(labels.tolist())
    are_numbers = all(text.parse_number(name) is not None for name in names)
    if len(names) > (2 if are_numbers else _most_classes(len(labels))):
        return ()
    lacking = sorted(names - set(labels[split == 0].tolist()), key=_order)
    for label in lacking:
        split[np.flatnonzero(labels == label)[0]] = 0
    if not lacking:
        return ()
    listed = shorten(", ".join(map(quote, lacking)), 200)
    return (f"one row of each of these rare classes was moved to the training split: {listed}",)


def _most_classes(rows: int) -> float:
    """Return the largest number of different labels that are accepted as classes in a table of `rows` rows."""
    return max(float(MANY_LABELS), rows / 2)


def _constant_targets(names: Sequence[str], training_values: np.ndarray) -> tuple[str, ...]:
    """Return a remark about targets that have the same value in all training rows."""
    constant = [
        f"{quote(name)} is {column[0]:g} in all training rows, so that nothing can be learned about it"
        for name, column in zip(names, training_values.T, strict=True)
        if column.min() == column.max()
    ]
    return tuple(constant)


def _encode(
    cells: Columns,
    rows: np.ndarray,
    training: np.ndarray,
    values: np.ndarray,
    question: Question,
    known_labels: tuple[str, ...],
) -> tuple[Target, Tensor]:
    """Return the description of the target, and the targets of the rows as a batch holds them.

    Args:
        cells: The table.
        rows: Indices of the rows that are used.
        training: Indices of the training rows.
        values: Targets of all rows.
        question: The settings of the data set.
        known_labels: Classes of a trained model; () for the labels of this table.

    Raises:
        DataError: The targets do not fit the kind, or a label is not a class of the trained model.
    """
    if question.kind == "real":
        as_float32(cells, question.target, rows, values[rows])  # refuses numbers beyond single precision
        training_values = values[training]
        constant = training_values.max(0) == training_values.min(0)
        deviation = np.where(constant, 1.0, training_values.std(0))
        mean = tuple(training_values.mean(0).tolist())
        target = Target("real", question.target, mean, tuple(deviation.tolist()))
        # double precision keeps small differences of large values
        return target, torch.from_numpy(values[rows])
    if question.kind == "degrees":
        # whole turns are removed before the conversion, because a multiple of 2π would be rounded
        angle = wrap(torch.from_numpy(np.deg2rad(np.fmod(values[rows], 360.0))))
        return Target("angle", question.target), angle.float()
    if question.kind == "radians":
        return Target("angle", question.target), wrap(torch.from_numpy(values[rows])).float()
    if known_labels:
        _check_known(cells, known_labels, rows, values, question.target[0])
        indices = {label: index for index, label in enumerate(known_labels)}
        return Target("class", known_labels), torch.tensor([indices[str(values[row])] for row in rows])
    labels = sorted(set(values[rows]), key=_order)
    _check_labels(cells, labels, rows, training, values, question.target[0])
    indices = {label: index for index, label in enumerate(labels)}
    return Target("class", tuple(labels)), torch.tensor([indices[values[row]] for row in rows])


def _check_known(
    cells: Columns, known_labels: Sequence[str], rows: np.ndarray, values: np.ndarray, name: str
) -> None:
    """Refuse a label that is not a class of the trained model; the message names the first such line."""
    known = set(known_labels)
    for row in rows:
        label = str(values[row])
        if label not in known:
            raise DataError(
                f"{cells.file} line {cells.lines[row]}, column {name!r}: The model does not know the class "
                f"{label!r}.{did_you_mean(label, known_labels)} Its classes are "
                f"{shorten(', '.join(known_labels))}. Write one of them, or leave the row out."
            )


def _check_labels(
    cells: Columns,
    labels: Sequence[str],
    rows: np.ndarray,
    training: np.ndarray,
    values: np.ndarray,
    name: str,
) -> None:
    """Refuse labels that cannot be classes, or that have no training row.

    Raises:
        DataError: There is only one label, the labels seem to be numbers, two labels are the same number, or a label
            does not occur in the training rows.
    """
    if len(labels) == 1:
        raise DataError(
            f"{cells.file}, column {name!r}: All rows have the label {labels[0]!r}, but at least two classes are "
            "required. Add rows of other classes, or name another data.target."
        )
    numeric_values = [text.parse_number(label) for label in labels]
    numeric = all(value is not None for value in numeric_values)
    fractional = any(value is not None and not value.is_integer() for value in numeric_values)
    if len(labels) > (MANY_LABELS if numeric and fractional else _most_classes(len(rows))):
        raise DataError(
            f"{cells.file}, column {name!r}: {len(labels)} different {'numbers' if numeric else 'labels'} in "
            f"{len(rows)} rows are not classes. "
            + ("Set data.kind=real or data.kind=degrees, or name" if numeric else "Name")
            + " another data.target."
        )
    spelling: dict[float, str] = {}
    for label, value in zip(labels, numeric_values, strict=True):
        if value is not None and spelling.setdefault(value, label) != label:
            raise DataError(
                f"{cells.file}, column {name!r}: The labels {spelling[value]!r} and {label!r} are the same number. "
                "Write each class in the same way in all rows."
            )
    unseen = set(labels) - set(values[training])
    if unseen:
        row = next(row for row in rows if values[row] in unseen)
        real = (
            " The labels look like numbers; set data.kind=real to predict numbers."
            if numeric and len(labels) > 2
            else ""
        )
        raise DataError(
            f"{cells.file} line {cells.lines[row]}, column {name!r}: No training row has the label {values[row]!r}, so "
            f"this class cannot be learned.{real} Add rows of this class, assign rows to splits in a column `{SPLIT}`, "
            "or set another data.data_seed."
        )


def _order(word: str) -> tuple[float, str]:
    """Return a sort key that sorts numbers by size and puts them before words."""
    value = number(word)
    return (float("inf") if value is None or value != value else value, word)
