"""Tests of mode=predict for a folder of flights: one row with intervals for each flight, and a message for the bad
file."""

import csv
from pathlib import Path

import pytest

from plugins.data.table_tennis.rows import table, write_csv
from tests.conftest import Framework


@pytest.mark.slow  # a solver is compiled and fits 12 flights
def test_a_folder_of_flights_becomes_positions_with_intervals(framework: Framework, tmp_path: Path) -> None:
    short = ("data.future=5", "data.flights=12", "data.stride=20", "density_head.identify=false", "metric=[]")
    made = framework(
        "experiment=table_tennis/ballistic", "debug=fast", *short, "logger=none", "threads=1", "pictures=false",
        folder="trained",
    )  # fmt: skip
    assert made.code == 0, made.out
    folder = tmp_path / "flights"
    folder.mkdir()
    for number in range(3):
        write_csv(folder / f"{number}.csv", table(number, 20))
    (folder / "1.csv").write_text("t,x,y,z\n0.0,1,2,broken\n")
    predict = ("mode=predict", f"checkpoint={made.folder}", f"mode.files={folder}", "logger=none")
    skip = ("data=table_tennis", "data.future=5", "data.unreadable=skip")
    done = framework(*predict, *skip, "mode.interval=0.9", folder="predicted")
    assert done.code == 0, done.out
    assert (done.folder / "unreadable.txt").read_text() == f"{folder / '1.csv'}\n"
    with (done.folder / "predictions.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["sample"] for row in rows] == [str(folder / "0.csv"), str(folder / "2.csv")]
    moments = [f"{16 * frame}ms" for frame in range(1, 6)]
    for row, number in zip(rows, (0, 2), strict=True):
        truth = table(number, 25)[20:]
        for frame, moment in enumerate(moments):
            for axis, name in enumerate("xyz"):
                low, point, high = (float(row[f"{name}_{moment}{end}"]) for end in ("_low", "", "_high"))
                assert low < point < high
                # without drag in `table`; with it in the model
                assert abs(point - truth[frame, 1 + axis]) < 0.1
