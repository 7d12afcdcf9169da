"""Tests of the first lines that a run prints about its data."""

from pathlib import Path

import pytest

from framework.configuration.schema import build, resolve
from framework.data import Data
from framework.runs.introduction import BUSY, Cores, lines, threads_line


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


CORES = Cores(2, 2, 0.1)


@pytest.mark.parametrize(
    ("threads", "chosen", "cores", "environment", "said"),
    [
        (2, None, CORES, {}, "threads: 2 on 2 cores, one for each core; threads=1 sets another number"),
        (1, None, Cores(1, 1, 0.0), {}, "threads: 1 on 1 core, one for each core"),
        (4, 4, CORES, {"OMP_NUM_THREADS": "1"}, "threads: 4 on 2 cores, as threads=4 says"),
        (1, None, CORES, {"OMP_NUM_THREADS": "1"}, "as OMP_NUM_THREADS=1 says, which a sweep sets"),
        (1, None, CORES, {"MKL_NUM_THREADS": "1"}, "as MKL_NUM_THREADS=1 says"),
        (
            2,
            None,
            Cores(2, 64, 0.0),
            {},
            "2 cores that this process may use of the machine's 64, one for each",
        ),
        (2, None, Cores(2, 2, 3.27), {}, "the machine's load was 3.3 in the last minute"),
    ],
)
def test_a_run_says_how_many_threads_compute_and_why(
    threads: int, chosen: int | None, cores: Cores, environment: dict[str, str], said: str
) -> None:
    line = threads_line(threads, chosen, cores, environment)
    assert said in line
    assert ("load" in line) == (cores.load >= BUSY)
