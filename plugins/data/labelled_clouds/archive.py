"""Reading of clouds of many sizes from one NumPy archive: `points`, `offset`, `label`, `object_id`, `classes`."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from framework.errors import DataError, shorten
from framework.storage.arrays import archive
from framework.storage.reading import guarded, read_bytes

SOURCE = "github.com/ATRM-Raphael/geo5017_A2"
WANTED = (
    "Wanted: a .npz archive with points (points, 3) in metres, offset (objects + 1), label (objects), classes, and "
    "perhaps object_id (objects); object i is points[offset[i]:offset[i+1]]."
)


class Archive(NamedTuple):
    """Arrays of the archive, which holds its objects one after another."""

    points: Float[np.ndarray, "points 3"]
    offset: Int[np.ndarray, "objects_and_one"]
    label: Int[np.ndarray, "objects"]
    identity: Int[np.ndarray, "objects"]
    classes: tuple[str, ...]


def read_archive(root: str | None) -> Archive:
    """Read and check the whole archive.

    Raises:
        DataError: there is no root, no such file, or no archive; an array is missing or of another shape; offsets do
            not rise; a label has no class; or a coordinate is not finite. The message names the object.
    """
    if root is None:
        raise DataError(
            f"data.root is not set: the objects were cut from the DALES scans and are not shipped or generated; an "
            f"extract of 499 of them is at {SOURCE}. {WANTED}"
        )
    file = Path(root).expanduser()
    with guarded(file, "a NumPy archive", WANTED, WANTED):
        return _checked(file, archive(read_bytes(file)))


def _checked(file: Path, held: dict[str, np.ndarray]) -> Archive:
    missing = [name for name in ("points", "offset", "label", "classes") if name not in held]
    if missing:
        raise DataError(
            f"{file} holds {shorten(', '.join(held)) or 'nothing'}, but no {missing[0]}. {WANTED}"
        )
    points, offset, label = held["points"], held["offset"], held["label"]
    identity = held.get("object_id", np.arange(len(label)))
    whole = all(array.ndim == 1 and array.dtype.kind in "iu" for array in (offset, label, identity))
    if points.dtype.kind != "f" or points.ndim != 2 or points.shape[1] != 3 or not whole:
        shapes = ", ".join(f"{name} {array.dtype} {array.shape}" for name, array in held.items())
        raise DataError(f"{file}: its arrays came as {shorten(shapes)}. {WANTED}")
    offset, label = offset.astype(np.int64), label.astype(np.int64)
    ends = len(offset) == len(label) + 1 == len(identity) + 1 and offset[0] == 0 and offset[-1] == len(points)
    if not ends or (np.diff(offset) < 1).any():
        raise DataError(
            f"{file}: {len(label)} labels, {len(identity)} identities and {len(offset)} offsets that do not cut "
            f"{len(points)} points into objects of at least one. {WANTED}"
        )
    classes = tuple(map(str, held["classes"].tolist()))
    wrong = np.flatnonzero((label < 0) | (label >= len(classes)))
    if len(wrong):
        raise DataError(
            f"{file}: object {wrong[0]} has label {label[wrong[0]]}, but there are {len(classes)} classes."
        )
    bad = np.flatnonzero(~np.isfinite(points).all(1))
    if len(bad):
        place = int(np.searchsorted(offset, bad[0], side="right")) - 1
        raise DataError(
            f"{file}: object {place} has a coordinate that is not finite, first its point {bad[0] - offset[place]}. "
            "Leave such points out of the archive."
        )
    return Archive(points, offset, label, identity.astype(np.int64), classes)
