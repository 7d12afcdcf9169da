"""Reading and writing of the label file of the CAVIAR crops, `or_label.mat`: MATLAB 5.

Its struct arrays `or_label_train` and `or_label_test` have one element for each image, whose fields are by their order
gaze (degrees), x, y, size and name without suffix; the names of the fields do not matter.
"""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.io

from framework.datasets.matlab import read_variables
from framework.errors import DataError, shorten
from plugins.data.head_pose.archive import TRAIN_AND_TEST

LABELS = "or_label.mat"
FIELDS = ("gaze", "x", "y", "size", "name")
HEADER = b"MATLAB 5.0 MAT-file, synthetic labels".ljust(116)  # SciPy's holds the date


class Label(NamedTuple):
    """Name of an image without suffix, and its gaze in degrees."""

    name: str
    gaze: float


def read_labels(file: Path) -> dict[str, list[Label]]:
    """Return the labels of "train" and "test", in the file's order.

    Raises:
        DataError: the file cannot be read, lacks a struct array, or one of its elements is not a label.
    """
    names = [f"or_label_{split}" for split in TRAIN_AND_TEST]
    content = read_variables(file, names)
    missing = [name for name in names if name not in content]
    if missing:
        raise DataError(f"{file}: holds no {' and no '.join(missing)}. Restore it from its source.")
    return {
        split: [
            _label(file, f"{name}({number})", entry)
            for number, entry in enumerate(np.atleast_1d(content[name]).ravel(), start=1)
        ]
        for split, name in zip(TRAIN_AND_TEST, names, strict=True)
    }


def _label(file: Path, where: str, entry: Any) -> Label:
    values = list(entry.values()) if isinstance(entry, dict) else [entry]
    if len(values) == len(FIELDS) and isinstance(values[-1], str) and values[-1]:
        gaze = np.asarray(values[0])
        if gaze.size == 1 and gaze.dtype.kind in "iuf":
            return Label(values[-1], float(gaze.item()))
    raise DataError(
        f"{file}: {where} holds {shorten(values)}; wanted a struct of {', '.join(FIELDS)}, gaze a number of degrees. "
        "Restore it from its source."
    )


def write_labels(file: Path, labels: Mapping[str, Sequence[Label]], side: int) -> None:
    """Write a label file as published, with x, y and size of a whole image; the same labels give the same bytes."""
    content = {}
    for split, found in labels.items():
        array = np.empty((1, len(found)), dtype=[(name, object) for name in FIELDS])
        for index, label in enumerate(found):
            array[0, index] = (label.gaze, side / 2, side / 2, float(side), label.name)
        content[f"or_label_{split}"] = array
    stream = io.BytesIO()
    scipy.io.savemat(stream, content, do_compression=True)
    file.write_bytes(HEADER + stream.getvalue()[len(HEADER) :])
