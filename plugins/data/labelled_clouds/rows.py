"""Rows of the contract: generated CAD models, a folder of pieces of land, and an archive of small objects."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from framework.testing.rows import DAMAGES, DataRow
from framework.testing.sample_files import meshes, surface, write_off

UNMISSED = ("empty", "cut", "garbage", "folder")
"""Kinds of damage that the data set detects; it cannot detect a missing file, which makes a smaller set."""
MODELS = {"train_models": 3, "test_models": 1, "points": 20, "classes": ["bowl", "cone", "stool"]}
CLASSES = ("building", "car", "tree")
MADE = {"data_seed": 1, "generator_seed": 1}


def folder_of_classes(folder: Path) -> Mapping[str, str]:
    """Write meshes and clouds of many sizes, in two classes."""
    for number in range(16):
        vertices, faces = surface(number, side=3 + number % 3)
        place = folder / ("hills" if number % 2 else "plains")
        if number % 4 < 2:
            write_off(place / f"{number:02d}.off", vertices, faces)
        else:
            np.savetxt(place / f"{number:02d}.xyz", vertices, header="x y z", comments="")
    return {"root": str(folder)}


def objects(counts: tuple[int, ...] = (11, 10, 12)) -> dict[str, np.ndarray]:
    """Return an archive's arrays: the given number of objects of each class, of 2 to 20 points each."""
    random = np.random.default_rng(0)
    label = random.permutation(np.repeat(np.arange(len(counts)), counts))
    sizes = random.integers(2, 21, len(label))
    return {
        "points": random.normal(size=(sizes.sum(), 3)).astype(np.float32),
        "offset": np.concatenate([[0], np.cumsum(sizes)]),
        "label": label,
        "object_id": np.arange(len(label)) + 100,
        "classes": np.array(CLASSES[: len(counts)]),
    }


def archive(folder: Path) -> Mapping[str, str]:
    """Write a few objects as one `.npz` archive."""
    np.savez(folder / "objects.npz", **objects())  # type: ignore[arg-type]
    return {"root": str(folder / "objects.npz")}


ROWS = {
    "modelnet40": (
        DataRow(
            "three classes",
            MODELS,
            synthetic=True,
            files=meshes,
            fragile={"bowl/train/*.off": UNMISSED, "cone/test/*.off": UNMISSED},
            skip={"unreadable": "skip"},
            changes={**MADE, "points": 30},
        ),
        DataRow(
            "normals, turned",
            {**MODELS, "normals": True, "rotations": 3},
            synthetic=True,
            files=meshes,
            changes={"rotations": 4},
        ),
    ),
    "point_cloud_folder": (
        DataRow(
            "pieces of land",
            write=folder_of_classes,
            synthetic=False,
            files=meshes,
            fragile={"hills/*.off": UNMISSED, "plains/*.xyz": UNMISSED},
            skip={"unreadable": "skip"},
            changes={"data_seed": 1, "points": 8},
        ),
        DataRow(
            "ten points, centred",
            {"points": 10, "centred": True},
            write=folder_of_classes,
            synthetic=False,
            files=meshes,
        ),
    ),
    "dales": (
        DataRow(
            "33 objects",
            write=archive,
            synthetic=False,
            files=meshes,
            fragile={"objects.npz": DAMAGES},
            changes={"data_seed": 1, "fold": 1, "points": 5},
        ),
        DataRow(
            "at most ten points", {"points": 10, "fold": 4}, write=archive, synthetic=False, files=meshes
        ),
    ),
}
