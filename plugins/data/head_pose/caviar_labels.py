"""Reading and writing of the label file of the CAVIAR crops, `or_label.mat`, a file of MATLAB 5.

The struct arrays `or_label_train` and `or_label_test` have one element for each image. The fields of an element are, in
this order, gaze (degrees), x, y, size and name without suffix; the names of the fields do not matter.
"""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.io

from framework.datasets.matlab import read_variables
from framework.errors import DataError, shorten
from framework.storage.names import is_within
from plugins.data.head_pose.archive import TRAIN_AND_TEST

LABELS = "or_label.mat"
FIELDS = ("gaze", "x", "y", "size", "name")
# SciPy's own header holds the date, which would change the bytes of the file
HEADER = b"MATLAB 5.0 MAT-file, synthetic labels".ljust(116)


class Label(NamedTuple):
    """Name of an image without suffix, and its gaze in degrees."""

    name: str
    gaze: float


def read_labels(file: Path) -> dict[str, list[Label]]:
    """Return the labels of "train" and "test", in the order of the file.

    Raises:
        DataError: The file cannot be read, lacks a struct array, or an element of the array is not a label.
    """
    names = [f"or_label_{split}" for split in TRAIN_AND_TEST]
    content = read_variables(file, names)
    missing = [name for name in names if name not in content]
    if missing:
        raise DataError(
            f"{file}: The file holds no {' and no '.join(missing)}. Copy the file again from its source."
        )
    return {
        split: [
            _label(file, f"{name}({number})", entry)
            for number, entry in enumerate(np.atleast_1d(content[name]).ravel(), start=1)
        ]
        for split, name in zip(TRAIN_AND_TEST, names, strict=True)
    }


def _label(file: Path, position: str, entry: Any) -> Label:
    """Return the label in one element of a struct array; `position` names the element in messages."""
    values = list(entry.values()) if isinstance(entry, dict) else [entry]
    if len(values) == len(FIELDS) and isinstance(values[-1], str) and values[-1] and is_within(values[-1]):
        gaze = np.asarray(values[0])
        if gaze.size == 1 and gaze.dtype.kind in "iuf":
            return Label(values[-1], float(gaze.item()))
    raise DataError(
        f"{file}: {position} holds {shorten(values)}; expected a struct of {', '.join(FIELDS)}, where gaze is a "
        "number of degrees and name that of an image in the folder. Copy the file again from its source."
    )


def write_labels(file: Path, labels: Mapping[str, Sequence[Label]], side: int) -> None:
    """Write a label file in the layout of the published `or_label.mat`; the same labels give the same bytes.

    The fields x, y and size of each label describe a head that fills an image of `side` × `side` pixels.
    """
    content = {}
    for split, labels_of_split in labels.items():
        array = np.empty((1, len(labels_of_split)), dtype=[(name, object) for name in FIELDS])
        for index, label in enumerate(labels_of_split):
            array[0, index] = (label.gaze, side / 2, side / 2, float(side), label.name)
        content[f"or_label_{split}"] = array
    stream = io.BytesIO()
    scipy.io.savemat(stream, content, do_compression=True)
    file.write_bytes(HEADER + stream.getvalue()[len(HEADER) :])
