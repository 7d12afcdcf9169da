"""Contract-test cases: a few simulated flights, a folder of a user's own, and the laboratory's layout."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.io import savemat

from framework.testing.rows import Damage, DataRow

SMALL = {"flights": 12, "observed": 6, "future": 4, "least": 4, "stride": 20}


def table(number: int, frames: int = 40) -> np.ndarray:
    """Return t, x, y, z (frame, 4) of a ball whose start depends on the number."""
    t = 0.016 * np.arange(frames)
    return np.column_stack([t, 0.1 * number + 0.5 * t, -4 + 5 * t, -0.6 + 1.5 * t - 4.9 * t**2])


def write_csv(file: Path, rows: np.ndarray) -> Path:
    """Write rows of t, x, y, z and return the file."""
    np.savetxt(file, rows, "%.6f", ",", header="t,x,y,z", comments="")
    return file


def write_csv_folder(folder: Path) -> Mapping[str, str]:
    """Write eight flights as CSV and a shorter recording of one of them; return the settings that name the folder."""
    for number in range(8):
        write_csv(folder / f"{number}.csv", table(number))
    write_csv(folder / "again.csv", table(3)[:30])
    return {"root": str(folder)}


def write_matlab(folder: Path) -> Mapping[str, str]:
    """Write one file in each of the laboratory's two layouts, and return the settings that name their folder.

    Two of the flights are in both files.
    """
    cells, times, balls = (np.empty(count, object) for count in (6, 4, 4))
    for number in range(6):
        cells[number] = table(number, 36)
    for number in range(4):
        whole = table(number + 4, 50)
        times[number], balls[number] = whole[:, 0], whole[:, 1:]
    savemat(folder / "ballTrain.mat", {"ballTrain": {"data": cells, "error": np.zeros(6)}})
    savemat(folder / "knn.mat", {"time": times, "ball": balls})
    return {"root": str(folder)}


def files(folder: Path) -> Sequence[Path]:
    """Write three flights for prediction."""
    return [write_csv(folder / f"{number}.csv", table(number + 20, 13 + number)) for number in range(3)]


DETECTED: tuple[Damage, ...] = ("empty", "garbage", "folder")
"""Kinds of damage that the data set detects.

It cannot detect a missing file, because the set without it is valid, or a file cut in half, which is a shorter flight.
"""
ROWS = {
    "table_tennis": (
        DataRow(
            "simulated",
            SMALL,
            synthetic=True,
            files=files,
            changes={"generator_seed": 1, "data_seed": 1, "future": 5},
        ),
        DataRow(
            "a user's folder",
            {**SMALL, "stride": 50, "forget": 0.2},
            write=write_csv_folder,
            synthetic=False,
            files=files,
            fragile={"*.csv": DETECTED},
            skip={"unreadable": "skip"},
            changes={"data_seed": 1, "stride": 8},
        ),
        DataRow(
            "of the laboratory",
            SMALL,
            write=write_matlab,
            synthetic=False,
            fragile={"ball*.mat": (*DETECTED, "cut")},
        ),
    ),
}
