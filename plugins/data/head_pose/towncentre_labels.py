"""Reading of the folders of the TownCentre heads: one folder for each person, and a text file for each image.

The text file `<stem>.txt` holds two lines, `pan = +123.45` in degrees and `valid = 1` or 0. Its image is the other file
whose name starts with `<stem>`; the second of the parts of its name that `_` separates is the person's number.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from framework.errors import DataError, quote, shorten
from framework.storage.reading import guarded, read_bytes
from framework.storage.text import decoded, no_number, value
from plugins.data.head_pose.archive import wrong_layout
from plugins.data.head_pose.labelled_images import SPLIT_SEED, Labelled

FOLDER = "TownCentreHeadImages"
TRAIN_SHARE, VALIDATION_SHARE = 0.8, 0.1


class Head(NamedTuple):
    """Image of person number `person`; pan is in radians, any number of turns."""

    image: Path
    person: int
    pan: float


class Found(NamedTuple):
    """Valid heads in a root, number of heads that are marked as not valid, and errors of labels that cannot be used."""

    heads: list[Head]
    invalid: int
    faults: list[DataError]


def find_heads(root: Path) -> Found:
    """Return all heads in a root, in the order of their names.

    Raises:
        DataError: the root holds no folder with label files.
    """
    found = Found([], 0, [])
    invalid, labels = 0, 0
    for folder in sorted(path for path in root.iterdir() if path.is_dir()):
        names = sorted(path.name for path in folder.iterdir())
        texts = [name for name in names if name.endswith(".txt")]
        pictures = [name for name in names if not name.endswith(".txt")]
        labels += len(texts)
        for text in texts:
            try:
                pan, valid = read_label(folder / text)
                if valid:
                    image = _image(folder, text, pictures)
                    found.heads.append(Head(image, _person(image), math.radians(pan)))
                else:
                    invalid += 1
            except DataError as error:
                found.faults.append(error)
    if not labels:
        raise wrong_layout(root, FOLDER, "folder in it holds a label file `<image>.txt`")
    return found._replace(invalid=invalid)


def read_label(file: Path) -> tuple[float, bool]:
    """Return pan in degrees, and whether the image may be used.

    Raises:
        DataError: the file cannot be read, or its lines are not those of a label.
    """
    with guarded(file, "a label"):
        text = decoded(read_bytes(file))
    entries = [line.partition("=") for line in text.splitlines()]
    fields = {name.strip(): value.strip() for name, _, value in entries}
    pan, valid = value(fields.get("pan", "")), {"0": False, "1": True}.get(fields.get("valid", ""))
    if pan is None or not math.isfinite(pan) or valid is None:
        line = next((number for number, (name, _, _) in enumerate(entries, 1) if name.strip() == "pan"), 0)
        why = f" Line {line}: {no_number(fields['pan'])}." if pan is None and line else ""
        raise DataError(
            f"{file}: {quote(text)}; wanted two lines, `pan = ` with finite degrees and `valid = ` with 0 or 1.{why} "
            "Restore it from its source."
        )
    return pan, valid


def _image(folder: Path, text: str, pictures: Sequence[str]) -> Path:
    """Return the image of a label: among those that start with its stem, the one that has no digit after it."""
    stem = text.removesuffix(".txt")
    names = [name for name in pictures if name.startswith(stem) and not name[len(stem) :][:1].isdigit()]
    if len(names) != 1:
        raise DataError(
            f"{folder / text}: {len(names)} images have names that start with {quote(stem)}"
            f"{': ' if names else ''}{shorten(', '.join(names[:3]))}; wanted one. Restore it, or take the label out."
        )
    return folder / names[0]


def _person(image: Path) -> int:
    parts = image.stem.split("_")
    if len(parts) < 2 or not parts[1].isdecimal():
        raise DataError(
            f"{image}: the name does not tell the person; wanted a number as the second of the parts that `_` "
            "separates. Restore the published name."
        )
    return int(parts[1])


def by_person(heads: Sequence[Head]) -> dict[str, list[Labelled]]:
    """Return the samples by split, 80, 10 and 10 % of the people, as in the thesis authors' code."""
    people = np.unique([head.person for head in heads])
    drawn = np.random.RandomState(SPLIT_SEED).rand(len(people))
    share = dict(zip(people.tolist(), drawn.tolist(), strict=True))
    splits: dict[str, list[Labelled]] = {"train": [], "validation": [], "test": []}
    for head in heads:
        splits[_split(share[head.person])].append(Labelled(head.image, (head.pan,)))
    return splits


def _split(share: float) -> str:
    if share < TRAIN_SHARE:
        return "train"
    return "validation" if share < TRAIN_SHARE + VALIDATION_SHARE else "test"


def label_text(pan: float, valid: bool) -> str:
    """Return the content of a label file; `pan` is in degrees."""
    return f"pan = {pan:+.2f}\nvalid = {int(valid)}\n"
