"""Contract-test cases: a blob that moves around a turntable, in the layout of the distributed MATLAB file."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.io import savemat

from framework.testing.rows import DAMAGES, DataRow
from framework.testing.sample_files import images


def turntable(symmetric: bool = False) -> np.ndarray:
    """Return views, (20, 72, 32, 32), of 20 blobs that move on a circle while the table rotates by 360°.

    A blob moves round once, or twice if `symmetric`.
    """
    angle = np.radians(5) * np.arange(72) * (2 if symmetric else 1)
    row, column = np.mgrid[:32, :32]
    views = []
    for number in range(20):
        centre = 16 + 8 * np.stack([np.cos(angle + number), np.sin(angle + number)], -1)
        squared_distance = (row - centre[:, :1, None]) ** 2 + (column - centre[:, 1:, None]) ** 2
        views.append(255 * np.exp(-squared_distance / 40))
    return np.stack(views).round().astype(np.uint8)


def as_matlab(folder: Path, views: np.ndarray, **more: object) -> Path:
    """Write 1440 views in the layout of COIL20.mat and return the folder."""
    pixels = views.swapaxes(-1, -2).reshape(1440, 1024)
    savemat(folder / "COIL20.mat", {"X": pixels, "Y": np.repeat(np.arange(1, 21), 72)[:, None], **more})
    return folder


def write(folder: Path) -> Mapping[str, str]:
    """Write the views of blobs on a turntable, and return the settings that name the folder."""
    return {"root": str(as_matlab(folder, turntable()))}


ROWS = {
    "coil20": (
        DataRow(
            "a blob",
            {"image_size": 16},
            write=write,
            synthetic=False,
            files=images,
            fragile={"COIL20.mat": DAMAGES},
            changes={"every": 30, "image_size": 17},
        ),
    )
}
