"""Conversion of a user's CSV table to tensors: choice of columns, rows and splits."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.data import Splits, as_inputs
from framework.datasets.angles import unlike_degrees, unlike_radians
from framework.datasets.csv_columns import (
    ColumnChoice,
    Columns,
    LabelledWriting,
    Writing,
    describe_choice,
    is_boolean,
    number,
    numbers,
    numeric_columns,
    read_columns,
    require,
    tables,
)
from framework.datasets.fields import Fields
from framework.distributions.circular import wrap
from framework.errors import DataError, did_you_mean, quote, shorten
from framework.storage import text
from framework.storage.arrays import to_real
from framework.target import Target

Kind = Literal["class", "real", "degrees", "radians"]
Missing = Literal["error", "skip"]
SPLITS = Splits._fields
SPLIT, GROUP = "split", "group"
MANY_LABELS = 20
"""Largest number of numeric labels that may be classes where most of them occur on one row only."""


class Question(NamedTuple):
    """Settings that say how a table is read; the names are those of the configuration."""

    target: tuple[str, ...]
    kind: Kind
    columns: tuple[str, ...] | None
    validation: float
    test: float
    data_seed: int
    missing: Missing


class Scaling(NamedTuple):
    """Scaling of each column x to (x / largest - mean) / deviation; it divides first, so that no square overflows."""

    largest: Float[np.ndarray, "column"]
    mean: Float[np.ndarray, "column"]
    deviation: Float[np.ndarray, "column"]


class Reading(NamedTuple):
    """Columns and scaling by which rows become inputs."""

    columns: tuple[str, ...]
    scaling: Scaling


def stored_reading(state: Mapping[str, Any]) -> Reading:
    """Return the reading of a model's training data from a checkpoint.

    Raises:
        DataError: the state is not one finite number for each column, or it would divide by 0.
    """
    columns: Sequence[Any] = state["columns"] if isinstance(state.get("columns"), list | tuple) else ()
    named = bool(columns) and all(isinstance(name, str) for name in columns)
    try:
        numbers = Scaling(*(np.array(state[name], np.float64) for name in Scaling._fields))
    except (KeyError, TypeError, ValueError):
        numbers = Scaling(*(np.zeros(0) for _ in Scaling._fields))
    if (
        not named
        or any(part.shape != (len(columns),) or not np.isfinite(part).all() for part in numbers)
        or (numbers.largest <= 0).any()
        or (numbers.deviation <= 0).any()
    ):
        raise DataError(
            f"tabular keeps {', '.join(Scaling._fields)} of each column of its training table, but was given something "
            "else. Load another checkpoint, or train anew."
        )
    return Reading(tuple(columns), numbers)


class Table(NamedTuple):
    """Everything that is read from a table: target, inputs, splits, and remarks about what was left out."""

    target: Target
    reading: Reading
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
    trained: Reading | None = None,
    writing: Writing | None = None,
    *,
    small_angles: bool = False,
) -> Table:
    """Read, check, split and standardise a table.

    Args:
        file: the CSV file.
        question: the settings of the data set.
        trained: the reading of the model for which the table is read; None to fit it to the table's training rows.
        writing: how the file is written.
        small_angles: whether angles in degrees may all lie within ±2π.

    Raises:
        DataError: the file, a column, a cell, a label or a split is not as wanted; the message names line and column.
    """
    cells = read_columns(file, writing or LabelledWriting())
    digest = hashlib.sha256(repr((cells.cells, question)).encode()).hexdigest()
    taken = _inputs(cells, question) if trained is None else _named(cells, question, trained.columns)
    columns = taken.names
    require(cells, columns, "The trained model")
    otherwise = "set data.missing=skip to leave such rows out" if question.missing == "error" else None
    inputs = np.stack([numbers(cells, name, missing=otherwise, booleans=True) for name in columns], -1)
    values, absent = _targets(cells, question, otherwise)
    _check_unit(cells, question, values, small_angles=small_angles)
    whole = ~(np.isnan(inputs).any(-1) | absent)
    rows = np.flatnonzero(whole)
    groups, group = _groups(file, cells, rows)
    split = _splits(cells, rows, question)
    training = rows[split == 0]
    scaling, constant = fit_scaling(inputs[training])
    scaling = scaling if trained is None else trained.scaling
    target, encoded = _encode(cells, rows, training, values, question)
    scaled = as_float32(cells, columns, rows, standardised(inputs[rows], scaling))
    lines = torch.tensor(cells.lines)[torch.from_numpy(rows)]
    parts = {}
    for number_of, name in enumerate(SPLITS):
        chosen = torch.from_numpy(split == number_of)
        parts[name] = Fields(
            input=scaled[chosen],
            target=encoded[chosen],
            group=group[chosen],
            line=lines[chosen],
            index=torch.arange(int(chosen.sum())),
        )
    sizes = {name: str(len(part)) for name, part in parts.items()}
    names = tuple(name for name, same in zip(columns, constant.tolist(), strict=True) if same)
    skipped = len(whole) - len(rows)
    reading = Reading(columns, scaling)
    return Table(
        target, reading, names, groups, Splits(**parts), sizes, skipped, digest, describe_choice(taken)
    )


def read(files: Sequence[Path], reading: Reading, writing: Writing | None = None) -> Fields:
    """Return the input columns of other files, standardised as the training rows were, one sample for each row.

    Raises:
        DataError: there is no file, or a file cannot be read, lacks a column, or has a cell that is no finite number.
    """
    parts = []
    for cells, inputs in tables(files, reading.columns, "The trained model", writing or LabelledWriting()):
        rows = np.arange(len(inputs))
        parts.append(as_float32(cells, reading.columns, rows, standardised(inputs, reading.scaling)))
    inputs = torch.cat(parts)
    return Fields(input=inputs, index=torch.arange(len(inputs)))


def of_rows(given: Any, reading: Reading) -> Float[Tensor, "row column"]:
    """Return standardised inputs from rows in memory: a DataFrame, a mapping by column, or an array in column order.

    Raises:
        DataError: a column is missing, a cell is not a finite number, or an array has another number of columns.
    """
    if hasattr(given, "columns") or isinstance(given, Mapping):
        missing = [name for name in reading.columns if name not in given]
        if missing:
            raise DataError(
                f"The model reads a column {missing[0]!r}, which is not given.{did_you_mean(missing[0], given)} "
                f"It reads: {', '.join(reading.columns)}."
            )
        given = np.stack([np.atleast_1d(np.asarray(given[name])) for name in reading.columns], -1)
    try:
        rows = to_real(given, "it")
    except (TypeError, ValueError) as error:
        raise DataError(
            f"{str(error)[:200]}; wanted rows of numbers: {', '.join(reading.columns)}."
        ) from error
    rows = as_inputs(rows, (len(reading.columns),)).numpy()
    scaled = standardised(rows, reading.scaling)
    wrong = np.argwhere(~(np.abs(scaled) <= np.finfo(np.float32).max))
    if len(wrong):
        row, column = wrong[0]
        raise DataError(
            f"row {row}, column {reading.columns[column]!r}: {rows[row, column]} is no finite number within single "
            "precision. Mend it, or leave the row out."
        )
    return torch.from_numpy(scaled.astype(np.float32))


def fit_scaling(inputs: Float[np.ndarray, "row column"]) -> tuple[Scaling, np.ndarray]:
    """Return the scaling to mean 0 and standard deviation 1, and a mask of the constant columns, which become 0."""
    constant = inputs.max(0) == inputs.min(0)
    largest = np.where(constant, 1.0, np.abs(inputs).max(0))
    shrunk = inputs / largest
    mean = np.where(constant, inputs[0], shrunk.mean(0))
    deviation = np.where(constant, 1.0, np.sqrt(np.square(shrunk - mean).mean(0)))
    return Scaling(largest, mean, deviation), constant


def standardised(
    inputs: Float[np.ndarray, "row column"], scaling: Scaling
) -> Float[np.ndarray, "row column"]:
    """Return the columns in standard deviations from their mean."""
    with np.errstate(over="ignore"):  # as_float32 refuses the result and names its place
        return (inputs / scaling.largest - scaling.mean) / scaling.deviation


def as_float32(
    cells: Columns,
    columns: Sequence[str],
    rows: Int[np.ndarray, "row"],
    values: Float[np.ndarray, "row column"],
) -> Float[Tensor, "row column"]:
    """Return the values in single precision.

    Raises:
        DataError: a number is too large for single precision; the message names line and column.
    """
    with np.errstate(over="ignore"):
        narrow = values.astype(np.float32)
    wrong = np.argwhere(~np.isfinite(narrow))
    if len(wrong):
        row, name = rows[wrong[0, 0]], columns[int(wrong[0, 1])]
        raise DataError(
            f"{cells.file} line {cells.lines[row]}, column {name!r}: {cells.cells[name][row]!r} lies beyond "
            "single precision (3.4e38), as it is or in standard deviations of the training rows. Mend the cell, or "
            "change the unit."
        )
    return torch.from_numpy(narrow)


def _inputs(cells: Columns, question: Question) -> ColumnChoice:
    require(cells, question.target, "data.target")
    if question.columns is not None:
        require(cells, question.columns, "data.columns")
        columns = tuple(dict.fromkeys(question.columns))
        known = set(columns) & set(question.target)
        if known:
            raise DataError(
                f"data.columns names {min(known)!r}, which is what is to be predicted (data.target). Take it out."
            )
        chosen = _named(cells, question, columns)
    else:
        chosen = numeric_columns(cells, (*question.target, SPLIT, GROUP), "data.columns")
    if not chosen.names:
        raise DataError(
            f"{cells.file} has no column of numbers to read beside {', '.join(question.target)}; its columns: "
            f"{shorten(', '.join(cells.cells))}. Name some with data.columns."
            + "".join(f" {quote(name)}: {why}." for name, why in list(chosen.left_out.items())[:8])
        )
    return chosen


def _named(cells: Columns, question: Question, columns: tuple[str, ...]) -> ColumnChoice:
    """Return the columns that are named, and list all others as left out."""
    known = (*columns, *question.target, SPLIT, GROUP)
    others = [name for name in cells.cells if name not in known]
    return ColumnChoice(columns, dict(cells.left_out) | dict.fromkeys(others, "not among those to read"), {})


def _targets(cells: Columns, question: Question, otherwise: str | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the targets as they are in the table, (row, name) numbers or (row,) labels, and which rows have none."""
    if question.kind != "class":
        for name in question.target:
            if is_boolean(cells, name):
                raise DataError(
                    f"{cells.file}, column {name!r}: {cells.cells[name][0]!r} and the like are two words; wanted "
                    f"numbers for data.kind={question.kind}. Set data.kind=class, or name another data.target."
                )
        values = np.stack([numbers(cells, name, missing=otherwise) for name in question.target], -1)
        return values, np.asarray(np.isnan(values).any(-1))
    name = question.target[0]
    labels = cells.cells[name]
    absent = np.array([label.lower() in cells.notation.missing for label in labels])
    if otherwise is not None and absent.any():
        row = int(absent.argmax())
        what = f"{labels[row]!r}, which says that there is no label" if labels[row] else "no label"
        where = " Or set data.missing_words=[] where that is a label." if labels[row] else ""
        raise DataError(
            f"{cells.file} line {cells.lines[row]}, column {name!r}: {what}. Write it, or {otherwise}.{where}"
        )
    return np.array(labels, dtype=object), absent


def _check_unit(cells: Columns, question: Question, values: np.ndarray, *, small_angles: bool) -> None:
    """Refuse angles that look like the other unit.

    Raises:
        DataError: the angles look like the other unit; the message names it, and what to set.
    """
    if question.kind not in ("degrees", "radians"):
        return
    for name, column in zip(question.target, values.T, strict=True):
        if question.kind == "radians":
            wrong = unlike_radians(column)
            way = "Set data.kind=degrees, or wrap the angles into one turn"
        else:
            wrong = "" if small_angles else unlike_degrees(column)
            way = "Set data.kind=radians, or data.small_angles=true where they are degrees"
        if wrong:
            raise DataError(f"{cells.file}, column {name!r}: {wrong}. {way}.")


def _groups(file: Path, cells: Columns, rows: np.ndarray) -> tuple[tuple[str, ...], Int[Tensor, "row"]]:
    if GROUP not in cells.cells:
        return (file.stem,), torch.zeros(len(rows), dtype=torch.int64)
    words = [cells.cells[GROUP][row] for row in rows]
    absent = [place for place, word in enumerate(words) if word.lower() in cells.notation.missing]
    if absent:
        word = words[absent[0]]
        why = f" ({word!r})" if word else ""
        raise DataError(
            f"{cells.file} line {cells.lines[rows[absent[0]]]}, column `{GROUP}`: no name{why}. "
            "Write one in every row, or rename the column."
            + (" Or set data.missing_words=[] where that is a name." if word else "")
        )
    groups = sorted(set(words), key=_order)
    numbered = {name: index for index, name in enumerate(groups)}
    return tuple(groups), torch.tensor([numbered[word] for word in words], dtype=torch.int64)


def _splits(cells: Columns, rows: np.ndarray, question: Question) -> Int[np.ndarray, "row"]:
    """Return the index into SPLITS of each row, from the column `split` or, without one, by shares of a permutation."""
    if SPLIT in cells.cells:
        for row, word in enumerate(cells.cells[SPLIT]):
            if word not in SPLITS:
                raise DataError(
                    f"{cells.file} line {cells.lines[row]}, column `{SPLIT}`: {word!r}; wanted one of "
                    f"{', '.join(SPLITS)}.{did_you_mean(word, SPLITS)}"
                )
        split = np.array([SPLITS.index(cells.cells[SPLIT][row]) for row in rows], dtype=np.int64)
        remedy = f"Say so of some rows in the column `{SPLIT}`."
    else:
        split = np.zeros(len(rows), dtype=np.int64)
        order = np.random.default_rng(question.data_seed).permutation(len(rows))
        validation, test = (round(share * len(rows)) for share in (question.validation, question.test))
        split[order[:validation]] = 1
        split[order[validation : validation + test]] = 2
        remedy = f"Add rows, change data.validation and data.test, or add a column `{SPLIT}`."
    for index, name in enumerate(SPLITS):
        if not (split == index).any():
            raise DataError(
                f"{cells.file}: the {name} split is empty ({len(rows)} rows, {len(cells.lines) - len(rows)} left out "
                f"for want of a number). {remedy}"
            )
    return split


def _encode(
    cells: Columns, rows: np.ndarray, training: np.ndarray, values: np.ndarray, question: Question
) -> tuple[Target, Tensor]:
    """Return the target's description, and its values as a batch holds them."""
    if question.kind == "real":
        as_float32(cells, question.target, rows, values[rows])  # refuses numbers beyond single precision
        seen = values[training]
        constant = seen.max(0) == seen.min(0)
        deviation = np.where(constant, 1.0, seen.std(0))
        target = Target("real", question.target, tuple(seen.mean(0).tolist()), tuple(deviation.tolist()))
        # keep double precision: small differences about a large value would be rounded away
        return target, torch.from_numpy(values[rows])
    if question.kind == "degrees":
        # remove whole turns before the unit is changed: their multiple of 2π would be rounded
        angle = wrap(torch.from_numpy(np.deg2rad(np.fmod(values[rows], 360.0))))
        return Target("angle", question.target), angle.float()
    if question.kind == "radians":
        return Target("angle", question.target), wrap(torch.from_numpy(values[rows])).float()
    labels = sorted(set(values[rows]), key=_order)
    _check_labels(cells, labels, rows, training, values, question.target[0])
    numbered = {label: index for index, label in enumerate(labels)}
    return Target("class", tuple(labels)), torch.tensor([numbered[values[row]] for row in rows])


def _check_labels(
    cells: Columns,
    labels: Sequence[str],
    rows: np.ndarray,
    training: np.ndarray,
    values: np.ndarray,
    name: str,
) -> None:
    if len(labels) == 1:
        raise DataError(
            f"{cells.file}, column {name!r}: every row is {labels[0]!r}; wanted two classes or more. Add rows of "
            "others, or name another data.target."
        )
    found = [text.parse_number(label) for label in labels]
    numeric = all(value is not None for value in found)
    broken = any(value is not None and not value.is_integer() for value in found)
    if numeric and len(labels) > (MANY_LABELS if broken else max(MANY_LABELS, len(rows) / 2)):
        raise DataError(
            f"{cells.file}, column {name!r}: {len(labels)} different numbers in {len(rows)} rows are no classes. Set "
            "data.kind=real or data.kind=degrees, or name another data.target."
        )
    written: dict[float, str] = {}
    for label, value in zip(labels, found, strict=True):
        if value is not None and written.setdefault(value, label) != label:
            raise DataError(
                f"{cells.file}, column {name!r}: the labels {written[value]!r} and {label!r} are the same number; "
                "wanted each class written in one way. Mend the column."
            )
    unseen = set(labels) - set(values[training])
    if unseen:
        row = next(row for row in rows if values[row] in unseen)
        real = (
            " These look like numbers: data.kind=real predicts them." if numeric and len(labels) > 2 else ""
        )
        raise DataError(
            f"{cells.file} line {cells.lines[row]}, column {name!r}: no training row is {values[row]!r}, so it cannot "
            f"be learned.{real} Add such rows, say in a column `{SPLIT}` which row is for what, or set another "
            "data.data_seed."
        )


def _order(word: str) -> tuple[float, str]:
    """Return a sort key that puts numbers by size before words."""
    value = number(word)
    return (float("inf") if value is None or value != value else value, word)
