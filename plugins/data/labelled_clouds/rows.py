"""Contract-test cases: generated CAD models, a folder of meshes and clouds, and an archive of small objects."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from framework.testing.rows import DAMAGES, DataRow
from framework.testing.sample_files import meshes, surface, write_off

DETECTED = ("empty", "cut", "garbage", "folder")
"""Kinds of damage that the data set detects; a missing file is not detected, because the other files are valid."""
MODELS = {"train_models": 3, "test_models": 1, "points": 20, "classes": ["bowl", "cone", "stool"]}
CLASSES = ("building", "car", "tree")
SEEDS = {"data_seed": 1, "generator_seed": 1}


def folder_of_classes(folder: Path) -> Mapping[str, str]:
    """Write meshes and clouds of many sizes in two classes, and return the settings that name the folder."""
    for number in range(16):
        vertices, faces = surface(number, side=3 + number % 3)
        class_folder = folder / ("hills" if number % 2 else "plains")
        if number % 4 < 2:
            write_off(class_folder / f"{number:02d}.off", vertices, faces)
        else:
            np.savetxt(class_folder / f"{number:02d}.xyz", vertices, header="x y z", comments="")
    return {"root": str(folder)}


def objects(counts: tuple[int, ...] = (11, 10, 12)) -> dict[str, np.ndarray]:
    """Return the arrays of an archive with `counts[i]` objects of class i, each with 2 to 20 points."""
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
    """Write a few objects as one `.npz` archive, and return the settings that name it."""
    np.savez(folder / "objects.npz", **objects())  # type: ignore[arg-type]
    return {"root": str(folder / "objects.npz")}


ROWS = {
    "modelnet40": (
        DataRow(
            "three classes",
            MODELS,
            synthetic=True,
            files=meshes,
            fragile={"bowl/train/*.off": DETECTED, "cone/test/*.off": DETECTED},
            skip={"unreadable": "skip"},
            changes={**SEEDS, "points": 30},
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
            fragile={"hills/*.off": DETECTED, "plains/*.xyz": DETECTED},
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
