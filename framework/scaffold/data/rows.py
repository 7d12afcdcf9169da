"""Contract rows: parameters with which `mode=check` tests the plugin, and the results that it expects."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from framework.testing.rows import DataRow


def files(folder: Path) -> Sequence[Path]:
    """Write two files of a user, and return their paths."""
    paths = [folder / "first.npy", folder / "second.npy"]
    for path, numbers in zip(paths, ([[0.0], [0.5]], [[-0.25]]), strict=True):
        np.save(path, np.array(numbers))
    return paths


ROWS = {
    "example": (
        DataRow(
            "defaults", {"samples": 60}, synthetic=True, files=files, changes={"data_seed": 1, "noise": 0.1}
        ),
    )
}
