"""Contract-test cases: images of a doll."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from framework.testing.bodies import write_body_file
from framework.testing.rows import DAMAGES, DataRow


def cut_out(folder: Path) -> Sequence[Path]:
    """Write two images with an alpha channel, and return their paths."""
    files = [folder / "one.png", folder / "other.png"]
    for number, file in enumerate(files):
        pixels = np.random.default_rng(number).integers(0, 256, (16, 12, 4), dtype=np.uint8)
        Image.fromarray(pixels).save(file)
    return files


ROWS = {
    "pose_from_image": (
        DataRow(
            "a doll",
            {"renderer": "rasterizer", "train": 3, "validation": 2, "test": 3, "height": 16, "width": 12},
            write=write_body_file,
            synthetic=True,
            files=cut_out,
            fragile={"doll.npz": DAMAGES},
            changes={
                "data_seed": 1,
                "test": 4,
                "pose_spread": 2.0,
                "turned_deg": 10.0,
                "moved": 0.1,
                "width": 16,
            },
        ),
    ),
}
