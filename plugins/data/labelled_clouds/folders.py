"""Layout of the folder of ModelNet40, <root>/<class>/{train,test}/<class>_<id>.off."""

from collections.abc import Sequence
from pathlib import Path

from framework.datasets.class_folders import FileList, collect, subfolders
from framework.errors import DataError, did_you_mean

OFFICIAL_REMEDY = "Set data.root to the unpacked ModelNet40, <root>/<class>/{train,test}/<class>_<id>.off."


def list_official(root: Path, classes: Sequence[str] | None, *, test_only: bool = False) -> FileList:
    """Return the files of a folder in the layout of ModelNet40, the training split first.

    Args:
        root: The folder.
        classes: Names of the classes to list; None for all.
        test_only: Whether folders test of some of the classes suffice, because the model is trained already.

    Raises:
        DataError: The folder is missing or has another layout, a class is unknown or without files, or there are fewer
            than two classes.
    """
    folders = subfolders(root, OFFICIAL_REMEDY)
    needed = ("test",) if test_only else ("train", "test")
    unexpected = [path.name for path in folders if not all((path / split).is_dir() for split in needed)]
    if unexpected or not folders:
        fault = (
            f"the folder {unexpected[0]} has no folder{'s' * (len(needed) > 1)} {' and '.join(needed)}"
            if unexpected
            else "it holds no folders"
        )
        raise DataError(f"data.root = {root} is not ModelNet40: {fault}. {OFFICIAL_REMEDY}")
    names = [path.name for path in folders]
    chosen = names if classes is None else sorted(set(classes))
    if test_only and set(chosen) & set(names):
        chosen = [name for name in chosen if name in names]
    for name in chosen:
        if name not in names:
            raise DataError(
                f"data.classes names {name!r}, which {root} does not hold.{did_you_mean(name, names)} "
                f"The classes there are {', '.join(names)}."
            )
    if len(chosen) < 2 and not test_only:
        raise DataError(
            f"data.classes = {chosen}, but at least two classes are required. Choose from {', '.join(names)}."
        )
    folders_of_class = [
        (name, split, root / name / split)
        for split in ("train", "test")
        for name in chosen
        if not test_only or (root / name / split).is_dir()
    ]
    return collect(chosen, folders_of_class, (".off",), ".off file", OFFICIAL_REMEDY)
