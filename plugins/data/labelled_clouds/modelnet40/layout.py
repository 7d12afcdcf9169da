"""The official layout: `<root>/<class>/{train,test}/*.off`."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from framework.errors import DataError, did_you_mean

WANTED = "Wanted: the unpacked ModelNet40, <root>/<class>/{train,test}/<class>_<id>.off."


class Listed(NamedTuple):
    """Classes in alphabetical order; of each split its files and their labels, by class and name."""

    classes: tuple[str, ...]
    files: dict[str, list[Path]]
    labels: dict[str, list[int]]


def listed(root: Path, wanted: Sequence[str] | None) -> Listed:
    """What a root holds; `wanted` None: all classes.

    Raises:
        DataError: no such folder, another layout, an unknown class, fewer than two classes, a class without files.
    """
    if not root.is_dir():
        raise DataError(f"data.root = {root}: no such folder. {WANTED}")
    folders = sorted(path for path in root.iterdir() if path.is_dir() and path.name[0] not in "._")
    strange = [path.name for path in folders if not ((path / "train").is_dir() and (path / "test").is_dir())]
    if strange or not folders:
        held = f"{strange[0]} has no folders train and test" if strange else "there are no folders in it"
        raise DataError(f"data.root = {root}: {held}. {WANTED}")
    names = [path.name for path in folders]
    chosen = names if wanted is None else sorted(set(wanted))
    for name in chosen:
        if name not in names:
            raise DataError(
                f"data.classes names {name!r}, which {root} does not hold.{did_you_mean(name, names)} "
                f"Its classes: {', '.join(names)}."
            )
    if len(chosen) < 2:
        raise DataError(f"data.classes = {chosen}: wanted at least two of {', '.join(names)}.")
    files: dict[str, list[Path]] = {"train": [], "test": []}
    labels: dict[str, list[int]] = {"train": [], "test": []}
    for label, name in enumerate(chosen):
        for split in files:
            found = sorted(path for path in (root / name / split).iterdir() if path.suffix.lower() == ".off")
            found = [path for path in found if not path.name.startswith(".")]
            if not found:
                raise DataError(f"{root / name / split} holds no .off file. {WANTED}")
            files[split] += found
            labels[split] += [label] * len(found)
    return Listed(tuple(chosen), files, labels)
