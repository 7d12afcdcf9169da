"""Folders in the layouts of the three published data sets, written for the tests."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.io
from PIL import Image

from framework.configuration.schema import build, resolve

PEOPLE = 40
"""Number of people in the folder of TownCentre heads, with two images each."""
CAVIAR_FIELDS = ("gaze", "x", "y", "size", "name")
Row = tuple[str, float, float, float]
"""Name, pan, tilt and roll of an IDIAP image."""


def prepare_data(name: str, root: Path | None, **config: Any) -> Any:
    """Return the prepared data set of this name, with a folder as its root."""
    data = build("data", resolve("data", {"name": name, "root": root and str(root), **config}))
    data.prepare()
    return data


# ---- 20 images in train/ and 11 in test/; the red value of an image is eight times its number ---------------------


def write_idiap(root: Path) -> Path:
    """Write a folder of IDIAP images with their labels, and return it."""
    _write_images(root, 75, "head_{}.png")
    publish_idiap(root)
    return root


def publish_idiap(
    root: Path, train: Iterable[int] = range(20), test: Iterable[int] = range(20, 31), **more: Any
) -> None:
    """Write the file of IDIAP labels of the images with the numbers `train` and `test` into the folder `root`.

    Each name in `more` adds a struct array to the file; its value holds the rows, as `idiap_row` returns them.
    """
    rows = {"or_label_train": [*map(idiap_row, train)], "or_label_test": [*map(idiap_row, test)], **more}
    save_idiap(root / "or_label_full.mat", **rows)


def idiap_row(number: int) -> Row:
    """Return the label of the image with this number; the angles are in radians."""
    return f"head_{number}.png", 0.1 * number - 1.5, 0.02 * number, -0.05 * number


def save_idiap(file: Path, *, column: bool = True, **structs: Sequence[Row]) -> None:
    """Write a file in the layout of MATLAB 7.3 for struct arrays.

    The group `#refs#` holds the values, and each field of a struct array is an array of references to these values.
    Text is a column of UTF-16 code units. The references of a field form a column if `column` is true, otherwise a row.
    """
    with h5py.File(file, "w", userblock_size=512) as content:
        cells = content.create_group("#refs#")
        for name, rows in structs.items():
            struct = content.create_group(name)
            for index, field in enumerate(("name", "pan", "tilt", "roll")):
                values = [
                    np.array([[ord(letter)] for letter in row[0]], dtype=np.uint16)
                    if field == "name"
                    else np.array([[row[index]]], dtype=np.float64)
                    for row in rows
                ]
                if len(values) == 1:  # a single struct holds its values itself
                    struct.create_dataset(field, data=values[0])
                    continue
                references = np.empty((len(values), 1), dtype=h5py.ref_dtype)
                for row, value in enumerate(values):
                    references[row, 0] = cells.create_dataset(f"{name}{field}{row}", data=value).ref
                struct.create_dataset(field, data=references if column else references.T)
    with file.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def write_caviar(root: Path) -> Path:
    """Write a folder of CAVIAR images with their labels, and return it."""
    _write_images(root, 50, "head_{}_x.jpg")
    publish_caviar(root)
    return root


def publish_caviar(root: Path, train: Iterable[int] = range(20), test: Iterable[int] = range(20, 31)) -> None:
    """Write the CAVIAR labels of the images with the numbers `train` and `test` into the folder `root`."""
    save_caviar(root, struct_array([*map(caviar_row, train)]), struct_array([*map(caviar_row, test)]))


def caviar_row(number: int) -> list[Any]:
    """Return gaze (10° × number - 180°), x, y, size and name of an image; x is uint8, as MATLAB writes integers."""
    return [10.0 * number - 180, np.uint8(25), 25.5, 50.0, f"head_{number}_x"]


def save_caviar(root: Path, train: np.ndarray, test: np.ndarray) -> None:
    """Write two struct arrays as the label file of the CAVIAR crops."""
    scipy.io.savemat(root / "or_label.mat", {"or_label_train": train, "or_label_test": test, "other": 3})


def struct_array(rows: Sequence[Sequence[Any]], names: Sequence[str] = CAVIAR_FIELDS) -> np.ndarray:
    """Return a MATLAB struct array with one element for each row, whose fields have the names `names`."""
    array = np.empty((1, len(rows)), dtype=[(name, object) for name in names])
    for index, row in enumerate(rows):
        array[0, index] = tuple(row)
    return array


def _write_images(root: Path, side: int, name: str) -> None:
    for split, numbers in (("train", range(20)), ("test", range(20, 31))):
        (root / split).mkdir(parents=True)
        for number in numbers:
            color = (8 * number, 100, 200)
            Image.new("RGB", (side, side), color).save(root / split / name.format(number), quality=100)


# ---- one folder for each person -----------------------------------------------------------------------------------


def write_towncentre(root: Path) -> Path:
    """Write a folder of TownCentre heads with two images of each person, and return it.

    The pan of person number p is 10° · p - 720° in the first image and 5° more in the second.
    """
    for person in range(PEOPLE):
        folder = root / f"person{person}"
        folder.mkdir(parents=True)
        for second in range(2):
            stem = f"image_{person}_{second}"
            Image.fromarray(pixels(2 * person + second)).save(folder / f"{stem}_17_{second}.png")
            pan = 10 * person + 5 * second - 720
            (folder / f"{stem}.txt").write_text(f"pan = {pan:+.2f}\nvalid = 1\n", encoding="utf-8")
    (root / "readme.md").write_text("not a folder", encoding="utf-8")
    return root


def pixels(number: int, side: int = 50) -> np.ndarray:
    """Return an image of noise (side, side, 3), with the number as its seed."""
    return np.random.default_rng(number).integers(0, 256, (side, side, 3), dtype=np.uint8)
