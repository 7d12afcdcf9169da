"""Layouts of a user's folder of labelled files: by class, by split and class, or by class and split."""

from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray

from framework.datasets.class_names import compare_classes
from framework.errors import DataError

SPLITS = ("train", "validation", "test")
"""Names of the folders of splits."""


OTHER_NAMES = {
    **{name: name for name in SPLITS},
    **dict.fromkeys(("training", "trainset", "train_set"), "train"),
    **dict.fromkeys(("val", "valid", "dev", "validate"), "validation"),
    **dict.fromkeys(("testing", "testset", "test_set", "eval"), "test"),
}
"""Names of splits in this and other programs, in small letters; each maps to the name of the split in `SPLITS`."""


def describe_layouts(suffixes: Iterable[str]) -> str:
    """Return advice that names the layouts that `list_files` reads, for files with these suffixes."""
    return (
        "Set data.root to a folder with the layout <root>/<class>/<file>, "
        "<root>/{train,validation,test}/<class>/<file> or <root>/<class>/{train,test}/<file>, where the files are "
        f"{', '.join(suffixes)}."
    )


class FileList(NamedTuple):
    """Files in a folder, with their classes and splits.

    Attributes:
        classes: Names of the classes in alphabetical order.
        files: The files.
        labels: Class of each file, an index into `classes`.
        splits: Split of each file; "" if it is to be chosen at random.
        ignored: Number of files of other kinds.
    """

    classes: tuple[str, ...]
    files: list[Path]
    labels: Int[np.ndarray, "files"]
    splits: NDArray
    ignored: int

    def select(self, indices: Iterable[int]) -> "FileList":
        """Return a list of only the files with these indices."""
        chosen = list(indices)
        files = [self.files[index] for index in chosen]
        return self._replace(files=files, labels=self.labels[chosen], splits=self.splits[chosen])


def list_files(
    root: Path, suffixes: Collection[str], fewest: int = 2, *, test_only: bool = False
) -> FileList:
    """Return the files of a user's folder that have one of the suffixes.

    Args:
        root: The folder.
        suffixes: Suffixes of the files, in small letters.
        fewest: Smallest number of classes.
        test_only: Whether files of the test split suffice, because the model is trained already.

    Raises:
        DataError: The folder is missing or has none of the layouts, a class has no files, there are fewer than
            `fewest` classes, or the names of two classes look the same.
    """
    remedy = describe_layouts(suffixes)
    folders = subfolders(root, remedy)
    names = {path.name for path in folders}
    if {"train", "test"} & names:
        needed = {"test"} if test_only else {"train", "test"}
        unexpected, missing = sorted(names - set(SPLITS)), sorted(needed - names)
        if unexpected or missing:
            optional = "only test must be there" if test_only else "only validation may be missing"
            fault = (
                f"holds a folder {unexpected[0]} beside folders of splits"
                if unexpected
                else f"holds no folder {missing[0]}"
            )
            raise DataError(
                f"data.root = {root} {fault}. The folders of splits are {', '.join(SPLITS)}; {optional}."
                f"{_suggest_split(unexpected)} {remedy}"
            )
        folders_of_class = [
            (inner.name, split.name, inner) for split in folders for inner in subfolders(split, remedy)
        ]
    else:
        inside = {path: [inner.name for inner in subfolders(path, remedy)] for path in folders}
        by_split = [path for path, inner_names in inside.items() if set(inner_names) == {"train", "test"}]
        for path, inner_names in inside.items():
            if by_split and path not in by_split:
                raise DataError(
                    f"data.root = {root}: The folder {path.name} has no folders train and test, but others have. "
                    + remedy
                )
            if inner_names and not by_split:
                raise DataError(
                    f"data.root = {root}: The folder {path.name} holds further folders ({', '.join(inner_names)})."
                    f"{_suggest_split([path.name])} {remedy}"
                )
        if not by_split and len(folders) > 1 and all(path.name.lower() in OTHER_NAMES for path in folders):
            raise DataError(
                f"data.root = {root}: The folders {', '.join(path.name for path in folders)} have the names of splits, "
                f"but hold no folders of classes. {remedy}"
            )
        splits = ("test", "train") if by_split else ("",)
        folders_of_class = [(path.name, split, path / split) for path in folders for split in splits]
    classes = sorted({name for name, _, _ in folders_of_class})
    compare_classes(classes, f"data.root = {root}")
    if len(classes) < fewest:
        content = f"only the class {classes[0]}" if classes else "no folder"
        raise DataError(
            f"data.root = {root} holds {content}, but folders of at least {fewest} classes are required. {remedy}"
        )
    folders_of_class.sort(key=lambda entry: (entry[1], entry[0]))
    return collect(classes, folders_of_class, suffixes, "file that can be read", remedy)


def _suggest_split(names: Iterable[str]) -> str:
    """Return ' Rename ...' for the first folder whose name resembles that of a split; "" if there is none."""
    for name in names:
        split = OTHER_NAMES.get(name.lower())
        if split is not None:
            return f" Rename the folder {name} to {split}."
    return ""


def collect(
    classes: Sequence[str],
    folders_of_class: Iterable[tuple[str, str, Path]],
    suffixes: Iterable[str],
    kind: str,
    remedy: str,
) -> FileList:
    """Return the files of folders with their class and split; hidden files and files of other suffixes are ignored.

    Args:
        classes: Names of the classes.
        folders_of_class: The folders, each with the name of its class and of its split: (class, split, folder).
        suffixes: Suffixes of the files to return, in small letters.
        kind: Name of a file with one of these suffixes, for messages.
        remedy: Advice in messages.

    Raises:
        DataError: A folder has no file with one of the suffixes.
    """
    files, labels, splits, ignored = [], [], [], 0
    for name, split, folder in folders_of_class:
        visible = (path for path in folder.iterdir() if not path.name.startswith("."))
        # a folder with such a suffix is listed too; the message about reading it says that it is not a file
        entries = sorted(path for path in visible if path.is_file() or path.suffix.lower() in suffixes)
        matching = [path for path in entries if path.suffix.lower() in suffixes]
        ignored += len(entries) - len(matching)
        if not matching:
            content = ", ".join(path.name for path in entries[:3])
            fault = f"holds no {kind}, but {content}" if entries else f"is empty, but a {kind} is required"
            raise DataError(f"{folder} {fault}. {remedy}")
        files += matching
        labels += [classes.index(name)] * len(matching)
        splits += [split] * len(matching)
    return FileList(tuple(classes), files, np.array(labels), np.array(splits, "<U10"), ignored)


def subfolders(root: Path, remedy: str) -> list[Path]:
    """Return the folders in `root`, sorted, without those whose names begin with a dot or an underscore.

    Raises:
        DataError: `root` is not a folder; the message ends with the advice `remedy`.
    """
    if not root.is_dir():
        raise DataError(f"data.root = {root} does not exist or is not a folder. {remedy}")
    return sorted(path for path in root.iterdir() if path.is_dir() and path.name[0] not in "._")
