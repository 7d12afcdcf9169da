"""Layouts of folders of meshes and clouds: by class, by split and class, or by class and split, as in ModelNet40."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray

from framework.errors import DataError, did_you_mean
from framework.geometry.meshes import READERS

SPLITS = ("train", "validation", "test")
OFFICIAL = "Wanted: the unpacked ModelNet40, <root>/<class>/{train,test}/<class>_<id>.off."
WANTED = (
    "Wanted: <root>/<class>/<file>, <root>/{train,validation,test}/<class>/<file> or "
    f"<root>/<class>/{{train,test}}/<file>, of {', '.join(READERS)}."
)


class Listed(NamedTuple):
    """Classes in alphabetical order; all files with labels and splits ("" if to be drawn); number of ignored files."""

    classes: tuple[str, ...]
    files: list[Path]
    labels: Int[np.ndarray, "files"]
    splits: NDArray
    ignored: int

    def only(self, numbers: Iterable[int]) -> "Listed":
        """Return the listing with only the files of the given numbers."""
        kept = list(numbers)
        files = [self.files[number] for number in kept]
        return self._replace(files=files, labels=self.labels[kept], splits=self.splits[kept])


def official(root: Path, wanted: Sequence[str] | None) -> Listed:
    """List the files of a root in ModelNet40's layout, its training split first; all classes if `wanted` is None.

    Raises:
        DataError: there is no such folder, another layout, an unknown class, fewer than two classes, or a class without
            files.
    """
    folders = _folders(root, OFFICIAL)
    strange = [path.name for path in folders if not ((path / "train").is_dir() and (path / "test").is_dir())]
    if strange or not folders:
        held = f"{strange[0]} has no folders train and test" if strange else "there are no folders in it"
        raise DataError(f"data.root = {root}: {held}. {OFFICIAL}")
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
    places = [(name, split, root / name / split) for split in ("train", "test") for name in chosen]
    return _collected(chosen, places, (".off",), ".off file", OFFICIAL)


def listed(root: Path) -> Listed:
    """List the files of a user's root.

    Raises:
        DataError: there is no such folder, none of the layouts, fewer than two classes, or a class without files.
    """
    folders = _folders(root, WANTED)
    names = {path.name for path in folders}
    if {"train", "test"} & names:
        strange = sorted(names - set(SPLITS)) or sorted({"train", "test"} - names)
        if strange:
            held = "is missing" if strange[0] in SPLITS else "stands beside"
            raise DataError(
                f"data.root = {root}: {strange[0]} {held} among {', '.join(SPLITS)}; of these validation may be left "
                f"out. {WANTED}"
            )
        places = [(inner.name, split.name, inner) for split in folders for inner in _folders(split, WANTED)]
    else:
        inside = {path: [inner.name for inner in _folders(path, WANTED)] for path in folders}
        by_split = [path for path, found in inside.items() if set(found) == {"train", "test"}]
        for path, found in inside.items():
            if by_split and path not in by_split:
                raise DataError(
                    f"data.root = {root}: {path.name} has no folders train and test, others have. {WANTED}"
                )
            if found and not by_split:
                raise DataError(
                    f"data.root = {root}: {path.name} holds folders ({', '.join(found)}). {WANTED}"
                )
        deeper = ("test", "train") if by_split else ("",)
        places = [(path.name, split, path / split) for path in folders for split in deeper]
    classes = sorted({name for name, _, _ in places})
    if len(classes) < 2:
        raise DataError(
            f"data.root = {root}: {len(classes)} classes ({', '.join(classes) or 'no folder'}); wanted at least two. "
            + WANTED
        )
    places.sort(key=lambda place: (place[1], place[0]))
    return _collected(classes, places, READERS, "file that can be read", WANTED)


def _collected(
    classes: Sequence[str],
    places: Iterable[tuple[str, str, Path]],
    suffixes: Iterable[str],
    kind: str,
    wanted: str,
) -> Listed:
    """Return the files of folders with their class and split; hidden files and files of other suffixes are ignored."""
    files, labels, splits, ignored = [], [], [], 0
    for name, split, folder in places:
        shown_files = (path for path in folder.iterdir() if not path.name.startswith("."))
        # keep a folder with such a suffix too: reading it then says that it is not a file
        held = sorted(path for path in shown_files if path.is_file() or path.suffix.lower() in suffixes)
        own = [path for path in held if path.suffix.lower() in suffixes]
        ignored += len(held) - len(own)
        if not own:
            shown = ", ".join(path.name for path in held[:3]) or "nothing"
            raise DataError(f"{folder} holds no {kind} ({shown}). {wanted}")
        files += own
        labels += [classes.index(name)] * len(own)
        splits += [split] * len(own)
    return Listed(tuple(classes), files, np.array(labels), np.array(splits, "<U10"), ignored)


def _folders(root: Path, wanted: str) -> list[Path]:
    if not root.is_dir():
        raise DataError(f"data.root = {root}: no such folder. {wanted}")
    return sorted(path for path in root.iterdir() if path.is_dir() and path.name[0] not in "._")
