"""Rows of the contract: a few simulated flights, a folder of a user's own, and the laboratory's layout."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.io import savemat
from torch import Tensor

from framework.target import Target
from framework.testing.rows import Damage, DataRow, EncoderRow, HeadRow, MetricRow

SMALL = {"flights": 12, "observed": 6, "future": 4, "least": 4, "stride": 20}


def table(number: int, frames: int = 40) -> np.ndarray:
    """t, x, y, z of a ball thrown from a place of its own."""
    t = 0.016 * np.arange(frames)
    return np.column_stack([t, 0.1 * number + 0.5 * t, -4 + 5 * t, -0.6 + 1.5 * t - 4.9 * t**2])


def write_csv(file: Path, rows: np.ndarray) -> Path:
    np.savetxt(file, rows, "%.6f", ",", header="t,x,y,z", comments="")
    return file


def folder(place: Path) -> Mapping[str, str]:
    """Eight flights, one of them twice, the second time cut short."""
    for number in range(8):
        write_csv(place / f"{number}.csv", table(number))
    write_csv(place / "again.csv", table(3)[:30])
    return {"root": str(place)}


def matlab(place: Path) -> Mapping[str, str]:
    """The laboratory's two layouts side by side, with two flights in both."""
    cells, times, balls = (np.empty(count, object) for count in (6, 4, 4))
    for number in range(6):
        cells[number] = table(number, 36)
    for number in range(4):
        whole = table(number + 4, 50)
        times[number], balls[number] = whole[:, 0], whole[:, 1:]
    savemat(place / "ballTrain.mat", {"ballTrain": {"data": cells, "error": np.zeros(6)}})
    savemat(place / "knn.mat", {"time": times, "ball": balls})
    return {"root": str(place)}


def files(place: Path) -> Sequence[Path]:
    return [write_csv(place / f"{number}.csv", table(number + 20, 13 + number)) for number in range(3)]


def thrown(count: int) -> Tensor:
    """What is read of six frames of balls that fall."""
    since = 0.016 * torch.arange(-5.0, 1.0).expand(count, -1)
    height = torch.linspace(-0.2, 0.2, count).unsqueeze(-1) - 4.9 * since.square()
    frames = [since, 0.5 * since, 5 * since - 3, height, torch.ones_like(since)]
    return torch.stack(frames, -1).flatten(1)


SEEN: tuple[Damage, ...] = ("empty", "garbage", "folder")
"""Which files there are is for the folder to say: one fewer is a smaller set, and half a flight is a shorter one."""
NOT_SMOOTH = "a search from what was seen; no gradient is claimed (forward says so)"
FLIGHT = Target("real", tuple(f"{axis}_{moment}ms" for moment in (16, 32) for axis in "xyz"))
THREE = Target("real", ("x", "y", "z"))
TVAE = {
    "name": "cvae", "latent": 2, "hidden": 8, "training_samples": 1, "samples": 10, "component": {"name": "gaussian"},
}  # fmt: skip
BOUND: Mapping[str, str] = dict.fromkeys(
    ("integral", "samples follow log_prob", "entropy", "mode"),
    "log_prob is the importance-weighted bound (eq. 3.19), the rest is of the mixture drawn from the prior",
)
DEEP = {"float32 against float64": 256.0}
"""Of seven layers one behind the other, the last of which multiplies numbers of the one before with a latent vector."""
DRAWN: Mapping[str, str] = dict.fromkeys(
    ("batches do not matter", "order does not matter", "states merge", "reset and copy"),
    "which flights are drawn depends on what was drawn before",
)
ROWS = {
    "ballistic": (
        EncoderRow("a thrown ball", (30,), {"future": 3}, inputs=thrown),
        *(
            HeadRow(
                density,
                FLIGHT,
                # constants are found in test_flights.py; of nonsense it takes a second each time
                {"observed": 4, "density": density, "steps": 6, "identify": False},
                leave_out={"loss gradient": NOT_SMOOTH},
            )
            for density in ("linearised", "sampled")
        ),
    ),
    "extrapolation": (EncoderRow("a thrown ball", (30,), {"future": 3}, inputs=thrown),),
    "lstm": (HeadRow("two frames", FLIGHT, {"observed": 4, "hidden": 8}),),
    "hybrid": (
        HeadRow("three numbers", THREE, {"further": 4, "hidden": 8}),
        HeadRow(
            "a CVAE over two frames",
            FLIGHT,
            {"further": 4, "hidden": 8, "component": TVAE},
            limits=DEEP,
            leave_out=BOUND,
        ),
    ),
    "flight_error": (MetricRow("two frames", FLIGHT, {"height": 0.0}, leave_out=DRAWN),),
    "table_tennis": (
        DataRow(
            "simulated",
            SMALL,
            synthetic=True,
            files=files,
            changes={"generator_seed": 1, "data_seed": 1, "future": 5},
        ),
        DataRow(
            "a folder of one's own",
            {**SMALL, "stride": 50, "forget": 0.2},
            write=folder,
            synthetic=False,
            files=files,
            fragile={"*.csv": SEEN},
            skip={"unreadable": "skip"},
            changes={"data_seed": 1, "stride": 8},
        ),
        DataRow(
            "of the laboratory", SMALL, write=matlab, synthetic=False, fragile={"ball*.mat": (*SEEN, "cut")}
        ),
    ),
}
