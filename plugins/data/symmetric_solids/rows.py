"""Contract-test cases: few small images."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from framework.testing.rows import DataRow


def grey_images(folder: Path) -> Sequence[Path]:
    """Write two grey images, and return their paths."""
    files = [folder / "one.png", folder / "other.png"]
    for number, file in enumerate(files):
        pixels = np.random.default_rng(number).integers(0, 256, (20, 20), dtype=np.uint8)
        Image.fromarray(pixels).save(file)
    return files


SMALL = {"train": 4, "validation": 3, "test": 3, "image_size": 16, "renderer": "rasterizer"}
ROWS = {
    "symmetric_solids": (
        DataRow(
            "four solids",
            SMALL,
            synthetic=True,
            files=grey_images,
            changes={"data_seed": 1, "test": 4, "label_noise_deg": 5.0, "solids": ["cube"], "image_size": 20},
        ),
        DataRow(
            "exact labels",
            {**SMALL, "solids": ["icosahedron", "cone"], "label_noise_deg": 0.0},
            synthetic=True,
            files=grey_images,
        ),
    ),
}
