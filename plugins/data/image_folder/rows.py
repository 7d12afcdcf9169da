"""Contract-test cases: images of noise in folders, in a table and in idx files, corrupted and turned."""

import gzip
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from framework.testing.finding import SEED
from framework.testing.rows import DAMAGES, DataRow
from framework.testing.sample_files import images, noise_image


def write_folders(folder: Path) -> Mapping[str, str]:
    """Write twenty images of each of two classes, and return the settings that name the folder."""
    for number in range(40):
        noise_image(folder / ("cat", "dog")[number % 2] / f"{number:03d}.png", number)
    return {"root": str(folder)}


def write_table(folder: Path) -> Mapping[str, str]:
    """Write forty images and a table of their labels and splits; return the settings that name it."""
    lines = ["file,label,split"]
    for number in range(40):
        file = noise_image(folder / f"{number:03d}.png", number)
        lines.append(
            f"{file.name},{'cat' if number % 2 else 'dog'},{('train', 'validation', 'test')[number % 3]}"
        )
    (folder / "labels.csv").write_text("\n".join(lines), encoding="utf-8")
    return {"root": str(folder), "csv": "labels.csv"}


def write_idx(folder: Path, count: int = 40, side: int = 9) -> Mapping[str, str]:
    """Write grey images of three classes as packed idx files, and return the settings that name the folder."""
    pixels = np.random.default_rng(SEED).integers(0, 256, (count, side, side), np.uint8)
    header = bytes([0, 0, 8, 3]) + b"".join(size.to_bytes(4, "big") for size in pixels.shape)
    (folder / "train-images-idx3-ubyte.gz").write_bytes(gzip.compress(header + pixels.tobytes(), mtime=0))
    labels = (np.arange(count) % 3).astype(np.uint8)
    header = bytes([0, 0, 8, 1]) + count.to_bytes(4, "big")
    (folder / "train-labels-idx1-ubyte").write_bytes(header + labels.tobytes())
    return {"root": str(folder)}


FOLDERS = DataRow(
    "folders",
    {"image_size": 8, "mirror": True, "policy": "random"},
    write=write_folders,
    synthetic=False,
    files=images,
    fragile={"*/*.png": [damage for damage in DAMAGES if damage != "missing"]},
    skip={"unreadable": "skip"},
    changes={"image_size": 9, "data_seed": 1, "test": 0.3, "corruption": "noise"},
)
TABLE = replace(
    FOLDERS,
    name="table, not varied",
    config={"image_size": 9, "grayscale": True, "jitter": 0.0},
    write=write_table,
    fragile={"*.png": DAMAGES, "labels.csv": DAMAGES},
    changes={"grayscale": False},
)
IDX = replace(
    FOLDERS,
    name="idx files, corrupted",
    config={"image_size": 9, "grayscale": True, "policy": "trivial", "corruption": "noise", "strength": 2},
    write=write_idx,
    fragile={"train-images-idx3-ubyte.gz": DAMAGES, "train-labels-idx1-ubyte": DAMAGES},
    skip={},
    changes={"strength": 3, "corruption": "blur", "classes": ["0", "1"]},
)
TURNED = replace(
    FOLDERS,
    config={"image_size": 9},
    changes={"image_size": 8, "data_seed": 1},
)
ROWS = {
    "image_folder": (FOLDERS, TABLE, IDX),
    "turned_images": (
        TURNED,
        replace(
            IDX,
            name="idx files, jittered",
            config={"image_size": 12, "jitter": 0.1, "centre": "mass"},
            changes={"classes": ["0"], "centre": "image"},
        ),
    ),
}
