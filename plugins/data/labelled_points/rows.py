"""Contract-test cases: scans of a hill with a wall, drawn at random or already in splits, in several formats."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from framework.testing.rows import DataRow

DETECTED = ("empty", "cut", "garbage", "folder")
"""Kinds of damage that the data set detects; a missing file is not detected, because the other files are valid."""


def scan(
    seed: int, ground: int = 40, wall: int = 20
) -> tuple[Float[np.ndarray, "p 3"], Int[np.ndarray, "p"]]:
    """Return the points of a hill (label 2) and of a wall on it (label 6), in random order, and their labels."""
    random = np.random.default_rng(seed)
    points = random.uniform([0, 0, 0], [10, 10, 0.2], (ground + wall, 3))
    points[ground:, 0], points[ground:, 2] = random.uniform(4, 7), random.uniform(0, 3, wall)
    order = random.permutation(ground + wall)
    return points[order], np.where(order < ground, 2, 6)


def write_ply(file: Path, points: Float[np.ndarray, "p 3"], labels: Int[np.ndarray, "p"]) -> None:
    """Write a scan as a PLY file of text with the property `label`."""
    header = (
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty double x\nproperty double y\n"
        "property double z\nproperty int label\nend_header\n"
    )
    lines = (f"{x} {y} {z} {label}\n" for (x, y, z), label in zip(points.tolist(), labels, strict=True))
    file.write_text(header + "".join(lines), encoding="utf-8")


def write_scan(file: Path, seed: int, ground: int = 40) -> None:
    """Write a scan as PLY, NPZ or XYZ, as the file's suffix says."""
    points, labels = scan(seed, ground)
    if file.suffix == ".ply":
        write_ply(file, points, labels)
    elif file.suffix == ".npz":
        np.savez(file, points=points, label=labels)
    else:
        np.savetxt(file, np.column_stack([points, labels]), header="x y z label", comments="")


def folder(root: Path) -> Mapping[str, str]:
    """Write ten scans without splits, and return the settings that name the folder."""
    for number in range(10):
        write_scan(root / f"tile_{number}{('.ply', '.npz', '.xyz')[number % 3]}", number, 40 + number)
    return {"root": str(root)}


def folders_of_splits(root: Path) -> Mapping[str, str]:
    """Write scans in folders of splits, and return the settings that name the folder above them."""
    for number, split in enumerate(("train", "train", "validation", "test", "test")):
        (root / split).mkdir(exist_ok=True)
        write_scan(root / split / f"tile_{number}.ply", number)
    return {"root": str(root)}


def files(root: Path) -> Sequence[Path]:
    """Write three scans for prediction and return their paths."""
    paths = [root / f"mine_{number}{suffix}" for number, suffix in enumerate((".ply", ".npz", ".xyz"))]
    for number, path in enumerate(paths):
        write_scan(path, 20 + number, 30 + number)
    return paths


ROWS = {
    "labelled_points": (
        DataRow(
            "ten scans",
            {"neighbours": 4, "surrounding_points": 0, "basis_points": 5, "points": 50},
            write=folder,
            synthetic=False,
            files=files,
            fragile={"tile_0.ply": DETECTED, "tile_1.npz": DETECTED},
            changes={"data_seed": 1, "points": 30, "neighbours": 3},
        ),
        DataRow(
            "folders of splits",
            {"neighbours": 2, "surrounding_points": 3},
            write=folders_of_splits,
            synthetic=False,
            files=files,
        ),
        DataRow(
            "position only",
            {"neighbours": 0, "surrounding_points": 0},
            write=folder,
            synthetic=False,
            files=files,
        ),
    ),
}
