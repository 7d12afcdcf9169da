"""Contract-test cases: one table, with a label, numbers or an angle as the target."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from framework.testing.rows import DAMAGES, DataRow

LABELS = ("cat", "dog", "emu")


def write(folder: Path, rows: int = 40) -> Mapping[str, str]:
    """Write a table with a number, its square, a group and three targets; return the settings that name the table."""
    lines = ["number,square,group,class,real,angle"]
    for row in range(rows):
        lines.append(f"{row},{row * row},{'ab'[row % 2]},{LABELS[row % 3]},{row / 2 - 3},{20 * row - 360}")
    (folder / "mine.csv").write_text("\n".join(lines), encoding="utf-8")
    return {"path": str(folder / "mine.csv")}


def files(folder: Path) -> Sequence[Path]:
    """Write two files, of two rows and of one row, with the input columns in different orders."""
    first, second = folder / "first.csv", folder / "second.csv"
    first.write_text("square,number\n9,3\n1000000,1000\n", encoding="utf-8")
    second.write_text("number,note,square\n5,hello,25\n", encoding="utf-8")
    return first, second


def row(name: str, target: object, kind: str) -> DataRow:
    """Return the test case with this target and kind."""
    return DataRow(
        name,
        {"target": target, "kind": kind, "columns": ["number", "square"]},
        write=write,
        synthetic=False,
        files=files,
        fragile={"mine.csv": DAMAGES},
        changes={"data_seed": 1, "test": 0.3, "columns": ["square", "number"]},
    )


def write_set(folder: Path) -> Mapping[str, str]:
    """Write a set with two inputs, a target and two splits; return the settings that name it."""
    lines = ["number,square,height,test_in_splits"]
    for row in range(40):
        lines.append(
            f"{row},{row * row},{row / 2 - 3},{'T.' if row % 4 == 0 else '.T' if row % 4 == 1 else '..'}"
        )
    (folder / "concrete.csv").write_text("\n".join(lines), encoding="utf-8")
    return {"root": str(folder)}


ROWS = {
    "uci": (
        DataRow(
            "a small set",
            {"validation": 0.2},
            write=write_set,
            synthetic=False,
            files=files,
            fragile={"concrete.csv": DAMAGES},
            changes={"split": 1, "data_seed": 1, "validation": 0.3},
        ),
    ),
    "tabular": (
        row("a label", "class", "class"),
        row("two numbers", ["real", "angle"], "real"),
        row("an angle", "angle", "degrees"),
    ),
}
