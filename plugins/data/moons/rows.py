"""Contract-test cases: small draws of both data sets."""

from collections.abc import Sequence
from pathlib import Path

from framework.testing.rows import DataRow


def files(folder: Path) -> Sequence[Path]:
    """Write two files with one and two points, whose columns are in different orders, and return their paths."""
    first, second = folder / "first.csv", folder / "second.csv"
    first.write_text("x,y\n0.50000000,-1.25\n", encoding="utf-8")
    second.write_text("y,note,x\n2,hello,1\n4.75,,-3.5\n", encoding="utf-8")
    return first, second


SIZES = {"train": 60, "validation": 40, "test": 30}
CHANGES = {"data_seed": 1, "test": 31}
ROWS = {
    "moons": (DataRow("moons", SIZES, synthetic=True, files=files, changes={**CHANGES, "noise": 0.2}),),
    "moons_outliers": (
        DataRow("discs", SIZES, synthetic=True, files=files, changes={**CHANGES, "radius": 0.5}),
    ),
}
