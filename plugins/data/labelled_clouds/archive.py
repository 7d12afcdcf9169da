"""Reading of labelled clouds from one NumPy archive: `points`, `offset`, `label`, `object_id`, `classes`."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from framework.errors import DataError, shorten
from framework.storage.arrays import read_npz
from framework.storage.reading import read_bytes, translate_errors

SOURCE = "github.com/ATRM-Raphael/geo5017_A2"
LAYOUT = (
    "a .npz archive with points (points, 3) in metres, offset (objects + 1), label (objects), classes, and optionally "
    "object_id (objects); object i is points[offset[i]:offset[i+1]]."
)
REMEDY = f"Set data.root to {LAYOUT}"


class Archive(NamedTuple):
    """Content of an archive, which holds its objects one after another.

    Attributes:
        points: Points of all objects, metres.
        offset: Index of the first point of each object, and the number of all points.
        label: Class of each object, an index into `classes`.
        identity: Identifier of the scanned object to which each object of the archive belongs.
        classes: Names of the classes.
    """

    points: Float[np.ndarray, "points 3"]
    offset: Int[np.ndarray, "objects_and_one"]
    label: Int[np.ndarray, "objects"]
    identity: Int[np.ndarray, "objects"]
    classes: tuple[str, ...]


def read_archive(root: str | None) -> Archive:
    """Read and check the whole archive.

    Raises:
        DataError: The root is not set or not an archive; an array is missing or of another shape; the numbers in
            `offset` do not rise; a label has no class; or a coordinate is not finite. The message names the object.
    """
    if root is None:
        raise DataError(
            f"data.root is not set. The objects were cut from the DALES scans and are neither shipped nor generated; "
            f"an extract of 499 objects is at {SOURCE}. {REMEDY}"
        )
    file = Path(root).expanduser()
    with translate_errors(file, "a NumPy archive", REMEDY, f"expected {LAYOUT} Correct data.root."):
        return _check_arrays(file, read_npz(read_bytes(file)))


def _check_arrays(file: Path, arrays: dict[str, np.ndarray]) -> Archive:
    """Return the archive's content, or raise a DataError if its arrays do not have the layout."""
    missing = [name for name in ("points", "offset", "label", "classes") if name not in arrays]
    if missing:
        raise DataError(
            f"{file} holds {shorten(', '.join(arrays)) or 'nothing'}, but no {missing[0]}. {REMEDY}"
        )
    points, offset, label = arrays["points"], arrays["offset"], arrays["label"]
    identity = arrays.get("object_id", np.arange(len(label)))
    integers = all(array.ndim == 1 and array.dtype.kind in "iu" for array in (offset, label, identity))
    if points.dtype.kind != "f" or points.ndim != 2 or points.shape[1] != 3 or not integers:
        shapes = ", ".join(f"{name} {array.dtype} {array.shape}" for name, array in arrays.items())
        raise DataError(
            f"{file}: The arrays have other types or shapes than expected: {shorten(shapes)}. {REMEDY}"
        )
    offset, label = offset.astype(np.int64), label.astype(np.int64)
    consistent = (
        len(offset) == len(label) + 1 == len(identity) + 1 and offset[0] == 0 and offset[-1] == len(points)
    )
    if not consistent or (np.diff(offset) < 1).any():
        raise DataError(
            f"{file}: the arrays `offset`, `label` and `object_id` have {len(offset)}, {len(label)} and "
            f"{len(identity)} numbers for {len(points)} points; expected offsets that ascend from 0 to "
            f"{len(points)}, and one label and one object_id for each object between two offsets. {REMEDY}"
        )
    classes = tuple(map(str, arrays["classes"].tolist()))
    unknown_label = np.flatnonzero((label < 0) | (label >= len(classes)))
    if len(unknown_label):
        raise DataError(
            f"{file}: Object {unknown_label[0]} has label {label[unknown_label[0]]}, but there are only {len(classes)} "
            "classes. Correct the label."
        )
    not_finite = np.flatnonzero(~np.isfinite(points).all(1))
    if len(not_finite):
        number = int(np.searchsorted(offset, not_finite[0], side="right")) - 1
        raise DataError(
            f"{file}: Point {not_finite[0] - offset[number]} of object {number} has a coordinate that is not finite. "
            "Leave such points out of the archive."
        )
    return Archive(points, offset, label, identity.astype(np.int64), classes)
