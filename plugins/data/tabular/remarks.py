"""Remarks on rows that make results or predictions look better than they are."""

import logging
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from framework.datasets.input_ranges import describe_far
from framework.errors import quote, shorten

Extent = tuple[Float[np.ndarray, "column"], Float[np.ndarray, "column"]]
"""Smallest and largest number of each input column in the training rows, in the units of the table."""
_log = logging.getLogger(__name__)


def describe_copies(
    inputs: Float[np.ndarray, "row column"],
    targets: np.ndarray,
    split: Int[np.ndarray, "row"],
    lines: Sequence[int],
) -> tuple[str, ...]:
    """Return a remark about rows for validation and test that also are training rows; () if there are none.

    Different observations may be equal if all columns have few values. Therefore a copy is reported only if the values
    of some column are different in more than half of the different rows.

    Args:
        inputs: Inputs of the rows that are used.
        targets: Targets of these rows: labels (row,) or numbers (row, name).
        split: Split of each row: 0 for training.
        lines: Line of each row in the file.
    """
    texts = np.asarray(targets, object).reshape(len(inputs), -1)
    rows = [(row.tobytes(), *target) for row, target in zip(inputs + 0.0, texts.tolist(), strict=True)]
    first = {row: lines[index] for index, row in reversed([*enumerate(rows)]) if split[index] == 0}
    copies = [
        (lines[index], first[row]) for index, row in enumerate(rows) if split[index] != 0 and row in first
    ]
    different = list(dict.fromkeys(rows))
    columns = [
        *np.stack([np.frombuffer(row[0]) for row in different]).T,
        *zip(*(row[1:] for row in different), strict=True),
    ]
    if not copies or max(len(set(column)) for column in columns) <= len(different) / 2:
        return ()
    line, original = copies[0]
    verb = "rows for validation and test have" if len(copies) > 1 else "row for validation or test has"
    return (
        f"{len(copies)} {verb} the same inputs and target as a training row, such as line {line} as line {original}; "
        "remove rows that were entered twice, because they make the test error too small",
    )


def describe_untested(
    classes: Sequence[str], labels: np.ndarray, split: Int[np.ndarray, "row"]
) -> tuple[str, ...]:
    """Return a remark about classes without a test row, on which the results say nothing; () if there are none.

    Args:
        classes: Names of the classes.
        labels: Class of each row, by name.
        split: Split of each row: 2 for the test.
    """
    tested = set(labels[split == 2].tolist())
    untested = [f"{quote(name)} ({(labels == name).sum()})" for name in classes if name not in tested]
    if not untested:
        return ()
    return (
        "no test row has these classes, so that the results say nothing about them (in parentheses: number of rows): "
        + shorten(", ".join(untested), 200),
    )


def describe_far_rows(
    names: Sequence[str], inputs: Float[np.ndarray, "row column"], extent: Extent | None
) -> tuple[str, ...]:
    """Return a remark about rows with inputs far outside the range of the training rows; () if there are none.

    Args:
        names: Names of the columns.
        inputs: The inputs, in the units of the table.
        extent: The ranges of the columns; None if they are not known.
    """
    sentence = None if extent is None else describe_far([quote(name) for name in names], inputs, *extent)
    if sentence is None:
        return ()
    return (f"{sentence}. If a column only names the rows, train without it (data.columns)",)


def report_far(names: Sequence[str], inputs: Float[np.ndarray, "row column"], extent: Extent | None) -> None:
    """Log the remark of `describe_far_rows` as a warning; do nothing if there is none."""
    for remark in describe_far_rows(names, inputs, extent):
        _log.warning("tabular: %s.", remark)
