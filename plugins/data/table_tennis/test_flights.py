"""Tests of flights from files and from the simulator, their windows, and what is refused."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from framework.configuration.schema import build, resolve
from framework.errors import DataError
from plugins.data.table_tennis.recordings import Flight
from plugins.data.table_tennis.rows import table, write_csv
from plugins.data.table_tennis.windows import Grid, believed, prefix, windows


def prepared(**config: Any) -> Any:
    data = build("data", resolve("data", {"name": "table_tennis", **config}))
    data.prepare()
    return data


@pytest.mark.parametrize(
    "line, rows, words",
    [
        ("0.050000,0.1,0.2,0.3", slice(0, 3), "line 5: the time 0.05 s comes after 0.08 s"),
        ("0.096000,0.1,0.2,inf", slice(0, 3), "line 8, column 'z'"),
        ("0.096000,0.1,0.2,1e9", slice(0, 3), "line 8: t, x, y, z"),
        ("0.096000,0.1,0.2", slice(0, 3), "line 8: 3 cells"),
    ],
)
def test_a_bad_frame_is_told_by_file_and_line(tmp_path: Path, line: str, rows: slice, words: str) -> None:
    file = write_csv(tmp_path / "bad.csv", table(0, 6))
    lines = file.read_text().splitlines()
    at = 4 if "0.05" in line else len(lines)
    lines.insert(at, line)
    if at == 4:
        lines[3] = lines[3].replace("0.032000", "0.080000")
    file.write_text("\n".join(lines))
    with pytest.raises(DataError, match=words.replace("(", r"\(")) as told:
        prepared(root=str(tmp_path))
    assert "bad.csv" in str(told.value)


def test_another_frame_rate_is_told_with_the_remedy(tmp_path: Path) -> None:
    rows = table(0)
    rows[:, 0] *= 4
    write_csv(tmp_path / "slow.csv", rows)
    with pytest.raises(DataError, match=r"a frame every 64 ms.*Set data.step=0.064"):
        prepared(root=str(tmp_path))
    rows[:, 0] *= 1e5
    write_csv(tmp_path / "slow.csv", rows)
    with pytest.raises(
        DataError, match=r"at most 1 s apart, in seconds or in data\.times_in\. Mend the times"
    ):
        prepared(root=str(tmp_path))


@pytest.mark.parametrize("unit, seconds", [("milliseconds", 1e-3), ("microseconds", 1e-6), ("seconds", 1.0)])
@pytest.mark.parametrize("said", ["seconds", "milliseconds", "microseconds"])
def test_times_in_another_unit_are_read_as_that_is_said(
    tmp_path: Path, unit: str, seconds: float, said: str
) -> None:
    """Check also that a wrong unit gives a message that names the right one, which the schema then takes."""
    tables = [table(number) for number in range(4)]
    for number, rows in enumerate(tables):
        write_csv(tmp_path / f"{number}.csv", np.column_stack([rows[:, 0] / seconds, rows[:, 1:]]))
    if said == unit:
        data = prepared(root=str(tmp_path), times_in=said, future=5)
        first = data.read([tmp_path / "0.csv"])[0]["input"].view(20, 5)
        np.testing.assert_allclose(first[-1, 1:4], tables[0][-1, 1:], atol=1e-5)
        np.testing.assert_allclose(first[-2, 0], -0.016, atol=1e-6)
    else:
        with pytest.raises(DataError, match=rf"0\.csv has a frame every .* Set data\.times_in={unit}\."):
            prepared(root=str(tmp_path), times_in=said, future=5)


def test_millimetres_and_other_columns_are_said(tmp_path: Path) -> None:
    for number in range(4):
        file = write_csv(tmp_path / f"{number}.csv", table(number))
        head, *lines = file.read_text().splitlines()
        file.write_text("\n".join([f"{head},spin,note", *(f"{line},3,x" for line in lines)]))
    assert prepared(root=str(tmp_path), future=5).remarks[0] == "left out: the columns spin, note"
    rows = table(0)
    rows[:, 1:] *= 1000
    write_csv(tmp_path / "0.csv", rows)
    with pytest.raises(
        DataError, match=r"0\.csv line 2: .* divide all of them by 1000 if they are millimetres"
    ):
        prepared(root=str(tmp_path), future=5)


def test_a_missing_frame_is_masked_and_a_gap_in_the_future_leaves_the_window_out() -> None:
    rows = table(0, 30)
    grid = Grid(observed=6, future=4, least=4, stride=1)
    whole = Flight("whole", rows[:, 0], rows[:, 1:])
    found = windows(whole, grid)
    assert [window.frame for window in found] == list(range(3, 26))
    np.testing.assert_allclose(found[2].target.reshape(4, 3), rows[6:10, 1:], atol=1e-9)
    holed = np.delete(rows, 10, 0)
    flight = Flight("holed", holed[:, 0], holed[:, 1:])
    read = prefix(flight, 11, grid)
    assert read is not None
    read = read.reshape(6, 5)
    assert read[:, 4].tolist() == [1, 1, 1, 0, 1, 1] and not read[3].any()
    np.testing.assert_allclose(read[0, :4], [-0.08, *rows[7, 1:]])
    # one missing frame is interpolated on the parabola, two are not
    one = next(window for window in windows(flight, grid) if window.frame == 8)
    np.testing.assert_allclose(one.target.reshape(4, 3)[1], rows[10, 1:], atol=1e-4)
    wide = np.delete(rows, [10, 11], 0)
    frames = [window.frame for window in windows(Flight("wide", wide[:, 0], wide[:, 1:]), grid)]
    assert not set(frames) & {6, 7, 8, 9} and {3, 4, 5, 10} <= set(frames)


def test_an_outlier_is_read_and_is_no_truth() -> None:
    rows = table(0, 30)
    rows[12, 1:] += [0.3, 0, 0.2]
    flight = Flight("strange", rows[:, 0], rows[:, 1:])
    assert np.flatnonzero(~believed(flight, 0.12)).tolist() == [12]
    grid = Grid(observed=6, future=4, least=4, stride=1)
    window = next(window for window in windows(flight, grid) if window.frame == 10)
    np.testing.assert_allclose(window.target.reshape(4, 3)[1], table(0, 30)[12, 1:], atol=1e-4)
    read = prefix(flight, 12, grid)
    assert read is not None
    np.testing.assert_allclose(read.reshape(6, 5)[-1, 1:4], rows[12, 1:])


@pytest.mark.skipif("REAL_DATA_ROOT" not in os.environ, reason="REAL_DATA_ROOT is not set")
def test_the_laboratorys_flights_are_82_and_none_is_in_two_splits() -> None:
    data = prepared(root=f"{os.environ['REAL_DATA_ROOT']}/trajectories", observed=12, future=22)
    words = data.fingerprint()
    assert words["repeated"] == "40"
    flights = [set(split.fields["flight"].tolist()) for split in data.splits()]
    assert sum(map(len, flights)) + int(words["too short"]) == 82
    assert not (flights[0] & flights[1] or flights[0] & flights[2] or flights[1] & flights[2])


def test_noise_and_constants_and_stiff_contact_change_what_is_simulated() -> None:
    small = {"flights": 5, "observed": 6, "future": 4, "least": 4, "stride": 20}
    digests = {prepared(**small, **more).fingerprint()["sha256"] for more in (
        {}, {"noise": 0.01}, {"drag": 0.1}, {"contact": "spring"}, {"outliers": 0.2}, {"dropped": 0.3},
    )}  # fmt: skip
    assert len(digests) == 6
