"""Reading of scans and of the labels of their points from a user's folder."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from framework.datasets.class_folders import SPLITS, subfolders
from framework.datasets.shares import check_shares, choose_splits
from framework.errors import DataError, did_you_mean, shorten
from framework.geometry import meshes

SUFFIXES = (".las", ".ply", ".npz", ".npy", ".xyz")
"""Suffixes of the files that are read; other formats have no column for a label."""
LAYOUT = (
    f"Set data.root to a folder with the layout <root>/<scan> or <root>/{{train,validation,test}}/<scan>, where the "
    f"scans are files of {', '.join(SUFFIXES)}."
)
LARGEST = 1e9
"""Largest magnitude of a label, so that labels are exact in every number type of the files."""


class LabelledScan(NamedTuple):
    """Points of a scan with the label of each, as in the file."""

    points: Float[np.ndarray, "points 3"]
    labels: Int[np.ndarray, "points"]


class ScanFiles(NamedTuple):
    """Files of scans with the split of each, "" if none is stated, and the number of files of other kinds."""

    files: list[Path]
    splits: NDArray
    ignored: int


def list_scans(root: Path, *, test_only: bool = False) -> ScanFiles:
    """Return the scans of a folder, with the splits that its folders state.

    Args:
        root: The folder.
        test_only: Whether scans of the test split suffice, because the model is trained already.

    Raises:
        DataError: The folder is missing or has another layout.
    """
    folders = [path for path in subfolders(root, LAYOUT) if path.name in SPLITS]
    if folders:
        names = {path.name for path in folders}
        missing = [
            name for name in ("train", "test") if name not in names and not (test_only and name == "train")
        ]
        if missing:
            raise DataError(
                f"data.root = {root} holds a folder {folders[0].name}, but no folder {missing[0]}. {LAYOUT}"
            )
        inside = [(path, folder.name) for folder in folders for path in sorted(folder.iterdir())]
    else:
        inside = [(path, "") for path in sorted(root.iterdir())]
    # a folder with such a suffix is listed too; the message about reading it says that it is not a file
    visible = [
        (path, split)
        for path, split in inside
        if path.name[0] != "." and (path.is_file() or path.suffix.lower() in SUFFIXES)
    ]
    scans = [(path, split) for path, split in visible if path.suffix.lower() in SUFFIXES]
    files, split_names = [path for path, _ in scans], np.array([split for _, split in scans], "<U10")
    for folder in folders:
        if folder.name not in split_names:
            raise DataError(f"{folder} holds no scan. {LAYOUT}")
    if not files:
        raise DataError(f"data.root = {root} holds no scan. {LAYOUT}")
    return ScanFiles(files, split_names, len(visible) - len(scans))


def divide_scans(
    listed: ScanFiles, root: Path, validation: float, test: float, random: np.random.Generator
) -> NDArray:
    """Return the split of each scan.

    Without folders of splits, whole scans are drawn for validation and test: at least one for each share above 0.

    Raises:
        DataError: There are too few scans for the splits.
    """
    count = len(listed.files)
    if "" in listed.splits:
        needed = 2 + (validation > 0)
        if count < needed:
            raise DataError(
                f"data.root = {root} holds {count} scans, but at least {needed} are needed: whole scans are drawn "
                f"for training, {'validation ' if validation else ''}and test. {LAYOUT}"
            )
        check_shares(validation, test)
        validation, test = (share and max(share, 1 / count) for share in (validation, test))
        if validation + test > 1 - 1 / count + 1e-9:
            raise DataError(
                f"data.validation and data.test leave none of the {count} scans of {root} for training. Reduce "
                "one of them."
            )
    return choose_splits(listed.splits, np.zeros(count, np.int64), validation, test, random)


class Classes(NamedTuple):
    """Names of the classes, and the label of each, ascending."""

    names: tuple[str, ...]
    labels: Int[np.ndarray, "classes"]

    def require_known(
        self, scans: Sequence[LabelledScan], sources: Sequence[str], unlabelled: Sequence[int]
    ) -> None:
        """Refuse a label that no class of a trained model has.

        Args:
            scans: The scans.
            sources: Name of each scan for the message.
            unlabelled: Labels that are no class.

        Raises:
            DataError: A point has such a label.
        """
        for source, scan in zip(sources, scans, strict=True):
            unknown = np.setdiff1d(scan.labels, [*unlabelled, *self.labels])
            if len(unknown):
                known = ", ".join(
                    f"{label} ({name})" for name, label in zip(self.names, self.labels, strict=True)
                )
                raise DataError(
                    f"{source}: a point has the label {unknown[0]}, but the model knows the labels {shorten(known)}. "
                    "Correct the label, or list it in data.unlabelled."
                )


def read_points(file: Path) -> Float[np.ndarray, "points 3"]:
    """Return the points of a scan without its labels.

    Raises:
        DataError: The file cannot be read, is empty, or a coordinate is not finite.
    """
    return _read(file).vertices


def read_labelled(file: Path, column: str) -> LabelledScan:
    """Return the points of a scan with their labels.

    Args:
        file: The scan.
        column: Name of the labels' column or array.

    Raises:
        DataError: The file cannot be read or has no such column, or a label is not an integer.
    """
    mesh = _read(file)
    name = column.lower()
    if mesh.attributes is None or name not in mesh.columns:
        raise DataError(
            f"{file} has no column {column!r} with one label for each of its {len(mesh.vertices)} points."
            f"{did_you_mean(name, mesh.columns)} Its columns beside x, y, z are: "
            f"{shorten(', '.join(mesh.columns)) or 'none'}. Set data.label to one of them, or add the labels; an array "
            "of another length than the points is not read."
        )
    values = mesh.attributes[:, mesh.columns.index(name)]
    wrong = np.flatnonzero(~((np.abs(values) <= LARGEST) & (values == np.round(values))))
    if len(wrong):
        raise DataError(
            f"{file}: point {wrong[0]} (from 0) has {column} = {values[wrong[0]]}; expected an integer. Correct the "
            "file, or mark points without a class by an integer that data.unlabelled lists."
        )
    return LabelledScan(mesh.vertices, values.astype(np.int64))


def _read(file: Path) -> meshes.Mesh:
    if file.suffix.lower() not in SUFFIXES:
        raise DataError(
            f"{file}: cannot be read; expected a scan whose name ends in {', '.join(SUFFIXES)}. Convert the file."
        )
    return meshes.read(file)


def choose_classes(
    scans: Sequence[LabelledScan],
    sources: Sequence[str],
    training: Sequence[int],
    names: Sequence[str] | None,
    unlabelled: Sequence[int],
) -> Classes:
    """Return the classes of scans for a training.

    Args:
        scans: All scans.
        sources: Name of each scan for messages.
        training: Indices of the scans for training.
        names: Names of the labels 0, 1, 2, …; None: the labels of the training scans are classes, named by their
            numbers.
        unlabelled: Labels that are no class.

    Raises:
        DataError: A label has no class, or the training scans hold fewer than two classes or not every class.
    """
    scan_labels = [np.setdiff1d(scan.labels, unlabelled) for scan in scans]
    learnt = np.unique(np.concatenate([scan_labels[number] for number in training]))
    labels = learnt if names is None else np.setdiff1d(np.arange(len(names)), unlabelled)
    for source, values in zip(sources, scan_labels, strict=True):
        unknown = np.setdiff1d(values, labels)
        if len(unknown):
            known = "of the training scans are" if names is None else "that data.classes names are"
            raise DataError(
                f"{source}: a point has the label {unknown[0]}, but the labels {known} "
                f"{shorten(', '.join(map(str, labels)))}. Correct the label, name it in data.classes, list it in "
                "data.unlabelled, or add a training scan with it."
            )
    if len(learnt) < 2:
        content = f"only the label {learnt[0]}" if len(learnt) else "no label"
        raise DataError(
            f"The training scans hold {content}, but at least two classes are needed. Add scans with other classes, or "
            "set data.label to the column of the classes."
        )
    names_of: dict[int, str] = {
        label: str(label) if names is None else names[label] for label in map(int, labels)
    }
    absent = np.setdiff1d(labels, learnt)
    if len(absent):
        raise DataError(
            f"The class {names_of[int(absent[0])]} (label {absent[0]}) has no point in the training scans, but "
            "every class needs one. Add scans, leave the class out of data.classes, or list its label in "
            "data.unlabelled."
        )
    return Classes(tuple(names_of.values()), labels)
