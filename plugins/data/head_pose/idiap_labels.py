"""Reading and writing of the label file of the IDIAP crops, `or_label_full.mat`, a file of MATLAB 7.3, which is HDF5.

The groups `or_label_train` and `or_label_test` of the file are struct arrays. Each of the fields pan, tilt, roll and
name holds one reference for each image, to a number or to UTF-16 text.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import h5py
import numpy as np

from framework.errors import DataError, quote
from framework.storage.names import is_within
from framework.storage.reading import open_regular, translate_errors
from plugins.data.head_pose.archive import TRAIN_AND_TEST

LABELS = "or_label_full.mat"
ANGLES = ("pan", "tilt", "roll")
UNIT_CHECK_MINIMUM = 20
"""Number of labels above which a file of degrees is refused if all its angles lie within ±2π.

Such angles are probably radians.
"""
MOST_LABELS, MOST_VALUES = 2**20, 2**12
"""Largest number of labels of a split, and largest number of letters of a name."""
HEADER = b"MATLAB 7.3 MAT-file, synthetic labels".ljust(116) + bytes(8) + b"\x00\x02IM"


class Label(NamedTuple):
    """Name of an image, and its angles pan, tilt and roll in the file's unit."""

    name: str
    angles: tuple[float, float, float]


def read_labels(file: Path, angles_in: Literal["radians", "degrees"]) -> dict[str, list[Label]]:
    """Return the labels of "train" and "test", in the order of the file, with angles in radians.

    Raises:
        DataError: The file is of another kind, a field is missing or of another length, or the angles seem to be in
            another unit than `angles_in`.
    """
    kind = (
        "the MATLAB 7.3 (HDF5) file of structs or_label_train and or_label_test with the fields pan, tilt, roll "
        "and name"
    )
    with translate_errors(file, kind), open_regular(file), h5py.File(file, "r") as content:
        labels = {split: _read_struct(content, f"or_label_{split}") for split in TRAIN_AND_TEST}
    _refuse_other_unit(file, labels, angles_in)
    if angles_in == "degrees":
        labels = {
            split: [_to_radians(label) for label in labels_of_split]
            for split, labels_of_split in labels.items()
        }
    return labels


def _to_radians(label: Label) -> Label:
    pan, tilt, roll = map(math.radians, label.angles)
    return Label(label.name, (pan, tilt, roll))


def _read_struct(content: h5py.File, name: str) -> list[Label]:
    struct = _member(content, name)
    fields = {field: _read_cells(content, _member(struct, field)) for field in (*ANGLES, "name")}
    lengths = {field: len(cells) for field, cells in fields.items()}
    if len(set(lengths.values())) != 1:
        raise ValueError(
            f"the fields of the struct {name} have different lengths: {lengths}; expected one length"
        )
    texts = [cell.astype("<u2").tobytes().decode("utf-16-le") for cell in fields["name"]]
    outside = [text for text in texts if not is_within(text)]
    if outside:
        raise ValueError(f"the image {quote(outside[0])} of {name} lies outside of the folder of the data")
    pan, tilt, roll = ([float(cell.item()) for cell in fields[angle]] for angle in ANGLES)
    return [
        Label(text, angles) for text, angles in zip(texts, zip(pan, tilt, roll, strict=True), strict=True)
    ]


def _member(group: Any, name: str) -> Any:
    """Return a member of an HDF5 group; refuse a link, because its target may be a pipe, which would never open.

    Raises:
        ValueError: The name leads to another place of this file or to another file.
        KeyError: There is no such member.
    """
    link = group.get(name, getlink=True)
    if link is not None and not isinstance(link, h5py.HardLink):
        raise ValueError(f"{name} is a link to another place or file; expected all values in this file")
    return group[name]


def _read_cells(content: Any, field: h5py.Dataset) -> list[np.ndarray]:
    """Return the arrays that the references in a field point to, one for each element of the struct array.

    If the struct array has only one element, the field holds the value instead of a reference.
    """
    if field.dtype != h5py.ref_dtype:
        return [_values(content, field, MOST_VALUES)]
    return [
        _values(content, content[reference], MOST_VALUES)
        for reference in _values(content, field, MOST_LABELS).ravel()
    ]


def _values(content: h5py.File, dataset: Any, most: int) -> np.ndarray:
    """Return all values of an HDF5 dataset of numbers or references.

    Raises:
        ValueError: The dataset holds something else or more than `most` values, or its values lie in another file.
    """
    chunk = math.prod(dataset.chunks or ())
    plain = dataset.dtype.kind in "iuf" or dataset.dtype == h5py.ref_dtype
    if not plain or max(dataset.size, chunk) > most:
        raise ValueError(
            f"the label {dataset.name} has the type {dataset.dtype}, the shape {dataset.shape} and chunks of "
            f"{dataset.chunks}; expected numbers or references, at most {most} in all and in a chunk"
        )
    if dataset.external or dataset.is_virtual or dataset.file.filename != content.filename:
        raise ValueError(
            f"the values of {dataset.name} lie in another file; expected all values in this file"
        )
    return dataset[()]


def _refuse_other_unit(
    file: Path, labels: Mapping[str, Sequence[Label]], angles_in: Literal["radians", "degrees"]
) -> None:
    """Raise a DataError if the angles seem to be in another unit than `angles_in`."""
    sizes = [
        abs(angle)
        for labels_of_split in labels.values()
        for label in labels_of_split
        for angle in label.angles
    ]
    largest = max(filter(math.isfinite, sizes), default=0.0)
    if angles_in == "radians" and largest > 2 * math.pi:
        raise DataError(
            f"{file}: Angles up to {largest:.4g} look like degrees, but radians are expected. "
            "Set data.angles_in=degrees."
        )
    if angles_in == "degrees" and len(sizes) > 3 * UNIT_CHECK_MINIMUM and 0 < largest <= 2 * math.pi:
        raise DataError(
            f"{file}: None of the {len(sizes)} angles exceeds {largest:.4g}. This looks like radians, but degrees are "
            "expected. Set data.angles_in=radians."
        )


def write_labels(file: Path, labels: Mapping[str, Sequence[Label]]) -> None:
    """Write a label file in the layout of MATLAB 7.3; the same labels give the same bytes."""
    with h5py.File(file, "w", userblock_size=512, libver="earliest") as content:
        cells = content.create_group("#refs#")

        def refer(value: np.ndarray, kind: str) -> h5py.Reference:
            cell = cells.create_dataset(f"{len(cells):07d}", data=value, track_times=False)
            cell.attrs["MATLAB_class"] = np.bytes_(kind)
            return cell.ref

        for split, labels_of_split in labels.items():
            struct = content.create_group(f"or_label_{split}")
            struct.attrs["MATLAB_class"] = np.bytes_("struct")
            columns = {
                angle: [refer(np.array([[label.angles[index]]]), "double") for label in labels_of_split]
                for index, angle in enumerate(ANGLES)
            }
            texts = [
                np.frombuffer(label.name.encode("utf-16-le"), np.uint16)[:, None] for label in labels_of_split
            ]
            columns["name"] = [refer(text, "char") for text in texts]
            for field, references in columns.items():
                struct.create_dataset(
                    field, data=np.array(references, dtype=h5py.ref_dtype)[:, None], track_times=False
                )
    with file.open("r+b") as stream:
        stream.write(HEADER)
