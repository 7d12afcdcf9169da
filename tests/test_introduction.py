"""What a run says first of its data."""

from pathlib import Path

import pytest

from framework.configuration.schema import build, resolve
from framework.data import Data
from framework.runs.introduction import lines


def prepared(**config: object) -> Data:
    data = build("data", resolve("data", config))
    data.prepare()
    return data


@pytest.mark.parametrize(
    ("kind", "target", "said"),
    [
        ("class", "label", "predicts one of 2 classes: a, b"),
        ("real", "x", "predicts numbers: x"),
        ("degrees", ["x", "turn"], "predicts angles: x, turn"),
    ],
)
def test_a_run_says_what_it_reads_predicts_and_leaves_out(
    tmp_path: Path, kind: str, target: object, said: str
) -> None:
    file = tmp_path / "one.csv"
    rows = [
        f"{row},{row * row % 7},{row * 10 - 7},{row * 31 % 360},{'ab'[row % 2]},word" for row in range(40)
    ]
    file.write_text("\n".join([",a,x,turn,label,note", *rows]), encoding="utf-8")
    found = lines(prepared(name="tabular", path=str(file), target=target, kind=kind))
    assert found[0].startswith("reads a")
    assert found[1:3] == [said, "samples: train 28, validation 6, test 6"]
    assert any("'note' (words)" in line and "row numbers" in line for line in found[3:])


def test_data_that_say_nothing_more_have_three_lines() -> None:
    found = lines(prepared(name="moons", train=20, validation=10, test=10))
    assert found == [
        "reads inputs of shape 2",
        "predicts one of 2 classes: upper, lower",
        "samples: train 20, validation 10, test 10",
    ]
