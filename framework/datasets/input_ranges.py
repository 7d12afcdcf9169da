"""Ranges of the inputs of a table in the training rows; an exported folder holds this file, which needs only NumPy."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_COLUMNS = 4
"""Largest number of columns that a sentence names."""


def is_far(inputs: NDArray[Any], low: NDArray[Any], high: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which inputs lie outside the range of the training rows by more than the width of this range.

    An input of a column that is constant in the training rows is far if it differs by more than rounding. A missing
    number, NaN, is not far.

    Args:
        inputs: inputs (row, column), in the units of the table.
        low: smallest number of each column in the training rows, (column,).
        high: largest number of each column in the training rows, (column,).

    Returns:
        Array (row, column).
    """
    with np.errstate(over="ignore"):  # an infinite width contains every number
        width = np.maximum(high - low, 1e-6 * np.maximum(np.abs(low), np.abs(high)))
        return np.asarray((inputs > high + width) | (inputs < low - width))


def describe_far(
    names: Sequence[str], inputs: NDArray[Any], low: NDArray[Any], high: NDArray[Any]
) -> str | None:
    """Return a sentence about rows with inputs far outside the range of the training rows; None if there are none.

    Args:
        names: names of the columns, as they are printed.
        inputs: inputs (row, column), in the units of the table.
        low: smallest number of each column in the training rows, (column,).
        high: largest number of each column in the training rows, (column,).
    """
    far = is_far(inputs, low, high)
    columns = np.flatnonzero(far.any(0)).tolist()
    if not columns:
        return None
    parts = []
    for column in columns[:MOST_COLUMNS]:
        least, largest = f"{low[column]:.10g}", f"{high[column]:.10g}"
        known = (
            f"{least} in all training rows"
            if least == largest
            else f"{least} to {largest} in the training rows"
        )
        example = inputs[int(far[:, column].argmax()), column]
        parts.append(f"{names[column]} is {example:.10g} in one of them, but {known}")
    if len(columns) > MOST_COLUMNS:
        parts.append(f"{len(columns) - MOST_COLUMNS} more columns")
    count = int(far.any(1).sum())
    return (
        f"{count} of {len(inputs)} rows {'lies' if count == 1 else 'lie'} far outside the training rows, so that "
        f"{'its prediction is' if count == 1 else 'their predictions are'} not reliable: {'; '.join(parts)}. "
        "Check the cells, or train with such rows"
    )
