"""Folders of meshes and clouds: by class, by split and class, or by class and split."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from framework.errors import DataError
from framework.geometry.meshes import READERS

SPLITS = ("train", "validation", "test")
WANTED = (
    "Wanted: <root>/<class>/<file>, <root>/{train,validation,test}/<class>/<file> or "
    f"<root>/<class>/{{train,test}}/<file>, of {', '.join(READERS)}."
)


class Listed(NamedTuple):
    """Classes in alphabetical order; every file with its label and its split (None: to be drawn); files of no use."""

    classes: tuple[str, ...]
    files: list[Path]
    labels: list[int]
    splits: list[str | None]
    ignored: int


def listed(root: Path) -> Listed:
    """What a root holds.

    Raises:
        DataError: no such folder, none of the layouts, fewer than two classes, a class without files.
    """
    if not root.is_dir():
        raise DataError(f"data.root = {root}: no such folder. {WANTED}")
    folders = _folders(root)
    names = [path.name for path in folders]
    if {"train", "test"} & set(names):
        strange = sorted(set(names) - set(SPLITS)) or sorted({"train", "test"} - set(names))
        if strange:
            held = "is missing" if strange[0] in SPLITS else "stands beside"
            raise DataError(
                f"data.root = {root}: {strange[0]} {held} among {', '.join(SPLITS)}; of these validation may be left "
                f"out. {WANTED}"
            )
        places = [(inner.name, split.name, inner) for split in folders for inner in _folders(split)]
    else:
        inside = {path: [inner.name for inner in _folders(path)] for path in folders}
        official = {path for path, found in inside.items() if set(found) == {"train", "test"}}
        if official and official != set(folders):
            other = sorted(set(folders) - official)[0]
            raise DataError(
                f"data.root = {root}: {other.name} has no folders train and test, others have. {WANTED}"
            )
        deeper = [path.name for path, found in inside.items() if found]
        if deeper and not official:
            raise DataError(
                f"data.root = {root}: {deeper[0]} holds folders ({', '.join(inside[root / deeper[0]])}). {WANTED}"
            )
        if official:
            places = [(path.name, split, path / split) for path in folders for split in ("train", "test")]
        else:
            places = [(path.name, None, path) for path in folders]
    return _collected(root, places)


def _collected(root: Path, places: Sequence[tuple[str, str | None, Path]]) -> Listed:
    classes = tuple(sorted({name for name, _, _ in places}))
    if len(classes) < 2:
        raise DataError(
            f"data.root = {root}: {len(classes)} classes ({', '.join(classes) or 'no folder'}); wanted at least two. "
            + WANTED
        )
    found = Listed(classes, [], [], [], 0)
    ignored = 0
    for name, split, folder in sorted(places, key=lambda place: (str(place[1]), place[0])):
        held = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
        own = [path for path in held if path.suffix.lower() in READERS]
        ignored += len(held) - len(own)
        if not own:
            shown = ", ".join(path.name for path in held[:3]) or "nothing"
            raise DataError(f"{folder} holds no file that can be read ({shown}). {WANTED}")
        found.files.extend(own)
        found.labels.extend([classes.index(name)] * len(own))
        found.splits.extend([split] * len(own))
    return found._replace(ignored=ignored)


def _folders(root: Path) -> list[Path]:
    return sorted(path for path in root.iterdir() if path.is_dir() and path.name[0] not in "._")
