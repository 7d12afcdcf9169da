"""Reading of the folders of the TownCentre heads: one folder for each person, and a label file for each image.

The label file `<stem>.txt` holds two lines, `pan = +123.45` in degrees and `valid = 1` or 0. The name of the image
starts with `<stem>`. If it is split at each `_`, its second part is the number of the person.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from framework.errors import DataError, quote, shorten
from framework.storage.reading import read_bytes, translate_errors
from framework.storage.text import decode, describe_no_number, parse_number
from plugins.data.head_pose.archive import wrong_layout
from plugins.data.head_pose.labelled_images import SPLIT_SEED, Labelled

FOLDER = "TownCentreHeadImages"
TRAIN_SHARE, VALIDATION_SHARE = 0.8, 0.1


class Head(NamedTuple):
    """Image of person number `person`; pan is in radians, not wrapped to one turn."""

    image: Path
    person: int
    pan: float


class HeadLabels(NamedTuple):
    """Labels of the heads in a root.

    Attributes:
        heads: The valid heads.
        invalid: Number of heads that their labels mark as not valid.
        faults: Errors of labels that cannot be used.
    """

    heads: list[Head]
    invalid: int
    faults: list[DataError]


def find_heads(root: Path) -> HeadLabels:
    """Return the labels of all heads in a root, sorted by folder and name.

    Raises:
        DataError: The root holds no folder with label files.
    """
    heads: list[Head] = []
    faults: list[DataError] = []
    invalid, labels = 0, 0
    for folder in sorted(path for path in root.iterdir() if path.is_dir()):
        names = sorted(path.name for path in folder.iterdir())
        texts = [name for name in names if name.endswith(".txt")]
        images = [name for name in names if not name.endswith(".txt")]
        labels += len(texts)
        for text in texts:
            try:
                pan, valid = read_label(folder / text)
                if valid:
                    image = _find_image(folder, text, images)
                    heads.append(Head(image, _person(image), math.radians(pan)))
                else:
                    invalid += 1
            except DataError as error:
                faults.append(error)
    if not labels:
        raise wrong_layout(root, FOLDER, "none of its folders holds a label file `<stem>.txt`")
    return HeadLabels(heads, invalid, faults)


def read_label(file: Path) -> tuple[float, bool]:
    """Return the pan in degrees, and whether the head is marked as valid.

    Raises:
        DataError: The file cannot be read, or is not a label file with the lines `pan` and `valid`.
    """
    with translate_errors(file, "a label"):
        text = decode(read_bytes(file))
    entries = [line.partition("=") for line in text.splitlines()]
    fields = {name.strip(): value.strip() for name, _, value in entries}
    pan, valid = parse_number(fields.get("pan", "")), {"0": False, "1": True}.get(fields.get("valid", ""))
    if pan is None or not math.isfinite(pan) or valid is None:
        line = next((number for number, (name, _, _) in enumerate(entries, 1) if name.strip() == "pan"), 0)
        reason = f" Line {line}: {describe_no_number(fields['pan'])}." if pan is None and line else ""
        raise DataError(
            f"{file}: {quote(text)} is not a label. Two lines are expected, `pan = ` with finite degrees and "
            f"`valid = ` with 0 or 1.{reason} Copy the file again from its source."
        )
    return pan, valid


def _find_image(folder: Path, label: str, images: Sequence[str]) -> Path:
    """Return the image whose name begins with the stem of the label file, not followed by a digit.

    Raises:
        DataError: No image or more than one image has such a name.
    """
    stem = label.removesuffix(".txt")
    names = [name for name in images if name.startswith(stem) and not name[len(stem) :][:1].isdigit()]
    if len(names) != 1:
        raise DataError(
            f"{folder / label}: {len(names)} images have names that start with {quote(stem)}"
            f"{': ' if names else ''}{shorten(', '.join(names[:3]))}; expected exactly one. "
            "Correct the names, or remove the label."
        )
    return folder / names[0]


def _person(image: Path) -> int:
    parts = image.stem.split("_")
    if len(parts) < 2 or not parts[1].isdecimal():
        raise DataError(
            f"{image}: The name does not hold the number of the person; expected a number as the second of the parts "
            "that `_` separates. Give the image its published name."
        )
    return int(parts[1])


def split_by_person(heads: Sequence[Head]) -> dict[str, list[Labelled]]:
    """Return the samples by split, with 80, 10 and 10 % of the people, as in the thesis authors' code."""
    people = np.unique([head.person for head in heads])
    uniform = np.random.RandomState(SPLIT_SEED).rand(len(people))
    share = dict(zip(people.tolist(), uniform.tolist(), strict=True))
    splits: dict[str, list[Labelled]] = {"train": [], "validation": [], "test": []}
    for head in heads:
        splits[_split(share[head.person])].append(Labelled(head.image, (head.pan,)))
    return splits


def _split(share: float) -> str:
    """Return the split of a person whose random number in [0, 1) is `share`."""
    if share < TRAIN_SHARE:
        return "train"
    return "validation" if share < TRAIN_SHARE + VALIDATION_SHARE else "test"


def label_text(pan: float, valid: bool) -> str:
    """Return the content of a label file; `pan` is in degrees."""
    return f"pan = {pan:+.2f}\nvalid = {int(valid)}\n"
