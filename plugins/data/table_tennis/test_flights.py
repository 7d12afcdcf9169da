"""Tests of flights from files and from the simulator, their windows, and what is refused."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from framework.configuration.schema import build, resolve
from framework.errors import DataError
from plugins.data.table_tennis.recordings import Flight, flights_of
from plugins.data.table_tennis.rows import table, write_csv
from plugins.data.table_tennis.windows import Grid, is_no_outlier, prefix, windows


def prepare_data(**config: Any) -> Any:
    data = build("data", resolve("data", {"name": "table_tennis", **config}))
    data.prepare()
    return data


@pytest.mark.parametrize(
    "line, message",
    [
        ("0.050000,0.1,0.2,0.3", "line 5: The time 0.05 s comes after 0.08 s"),
        ("0.096000,0.1,0.2,inf", "line 8, column 'z'"),
        ("0.096000,0.1,0.2,1e9", "line 8: t, x, y, z"),
        ("0.096000,0.1,0.2", "line 8: the line has 3 cells"),
    ],
)
def test_the_message_about_a_bad_frame_names_file_and_line(tmp_path: Path, line: str, message: str) -> None:
    file = write_csv(tmp_path / "bad.csv", table(0, 6))
    lines = file.read_text().splitlines()
    index = 4 if "0.05" in line else len(lines)
    lines.insert(index, line)
    if index == 4:
        lines[3] = lines[3].replace("0.032000", "0.080000")
    file.write_text("\n".join(lines))
    with pytest.raises(DataError, match=message.replace("(", r"\(")) as error:
        prepare_data(root=str(tmp_path))
    assert "bad.csv" in str(error.value)


def test_the_message_about_another_frame_rate_names_the_remedy(tmp_path: Path) -> None:
    rows = table(0)
    rows[:, 0] *= 4
    write_csv(tmp_path / "slow.csv", rows)
    with pytest.raises(DataError, match=r"a frame every 64 ms.*Set data.step=0.064"):
        prepare_data(root=str(tmp_path))
    rows[:, 0] *= 1e5
    write_csv(tmp_path / "slow.csv", rows)
    with pytest.raises(DataError, match=r"at most 1 s apart\. Correct the times, or set data\.times_in"):
        prepare_data(root=str(tmp_path))


@pytest.mark.parametrize("unit, seconds", [("milliseconds", 1e-3), ("microseconds", 1e-6), ("seconds", 1.0)])
@pytest.mark.parametrize("times_in", ["seconds", "milliseconds", "microseconds"])
def test_times_are_read_in_the_configured_unit(
    tmp_path: Path, unit: str, seconds: float, times_in: str
) -> None:
    """Check also that the message about a wrong unit names the right one."""
    tables = [table(number) for number in range(4)]
    for number, rows in enumerate(tables):
        write_csv(tmp_path / f"{number}.csv", np.column_stack([rows[:, 0] / seconds, rows[:, 1:]]))
    if times_in == unit:
        data = prepare_data(root=str(tmp_path), times_in=times_in, future=5)
        first = data.read([tmp_path / "0.csv"])[0]["input"].view(20, 5)
        np.testing.assert_allclose(first[-1, 1:4], tables[0][-1, 1:], atol=1e-5)
        np.testing.assert_allclose(first[-2, 0], -0.016, atol=1e-6)
    else:
        with pytest.raises(DataError, match=rf"0\.csv has a frame every .* Set data\.times_in={unit}\."):
            prepare_data(root=str(tmp_path), times_in=times_in, future=5)


def test_unread_columns_are_remarked_and_millimetres_are_recognised(tmp_path: Path) -> None:
    for number in range(4):
        file = write_csv(tmp_path / f"{number}.csv", table(number))
        head, *lines = file.read_text().splitlines()
        file.write_text("\n".join([f"{head},spin,note", *(f"{line},3,x" for line in lines)]))
    assert prepare_data(root=str(tmp_path), future=5).remarks[0] == "left out: the columns spin, note"
    rows = table(0)
    rows[:, 1:] *= 1000
    write_csv(tmp_path / "0.csv", rows)
    with pytest.raises(
        DataError, match=r"0\.csv line 2: .* set data.lengths_in to millimetres or centimetres"
    ):
        prepare_data(root=str(tmp_path), future=5)
    data = prepare_data(root=str(tmp_path), future=5, lengths_in="millimetres")
    read = data.read([tmp_path / "0.csv"])[0]["input"].view(20, 5)
    np.testing.assert_allclose(read[-1, 1:4], table(0)[-1, 1:], atol=1e-5)


def test_a_missing_frame_is_masked_and_a_gap_in_the_future_leaves_the_window_out() -> None:
    rows = table(0, 30)
    grid = Grid(observed=6, future=4, least=4, stride=1)
    whole = Flight("whole", rows[:, 0], rows[:, 1:])
    complete = windows(whole, grid)
    assert [window.frame for window in complete] == list(range(3, 26))
    np.testing.assert_allclose(complete[2].target.reshape(4, 3), rows[6:10, 1:], atol=1e-9)
    without_frame = np.delete(rows, 10, 0)
    flight = Flight("one frame missing", without_frame[:, 0], without_frame[:, 1:])
    inputs = prefix(flight, 11, grid)
    assert inputs is not None
    frames = inputs.reshape(6, 5)
    assert frames[:, 4].tolist() == [1, 1, 1, 0, 1, 1] and not frames[3].any()
    np.testing.assert_allclose(frames[0, :4], [-0.08, *rows[7, 1:]])
    # one missing frame is interpolated on the parabola, two are not
    window = next(window for window in windows(flight, grid) if window.frame == 8)
    np.testing.assert_allclose(window.target.reshape(4, 3)[1], rows[10, 1:], atol=1e-4)
    with_gap = np.delete(rows, [10, 11], 0)
    last_frames = [window.frame for window in windows(Flight("gap", with_gap[:, 0], with_gap[:, 1:]), grid)]
    assert not set(last_frames) & {6, 7, 8, 9} and {3, 4, 5, 10} <= set(last_frames)


def test_an_outlier_is_read_but_is_no_target() -> None:
    rows = table(0, 30)
    rows[12, 1:] += [0.3, 0, 0.2]
    flight = Flight("outlier", rows[:, 0], rows[:, 1:])
    assert np.flatnonzero(~is_no_outlier(flight, 0.12)).tolist() == [12]
    grid = Grid(observed=6, future=4, least=4, stride=1)
    window = next(window for window in windows(flight, grid) if window.frame == 10)
    np.testing.assert_allclose(window.target.reshape(4, 3)[1], table(0, 30)[12, 1:], atol=1e-4)
    inputs = prefix(flight, 12, grid)
    assert inputs is not None
    np.testing.assert_allclose(inputs.reshape(6, 5)[-1, 1:4], rows[12, 1:])


@pytest.mark.skipif("REAL_DATA_ROOT" not in os.environ, reason="REAL_DATA_ROOT is not set")
def test_the_laboratorys_flights_are_82_and_none_is_in_two_splits() -> None:
    data = prepare_data(root=f"{os.environ['REAL_DATA_ROOT']}/trajectories", observed=12, future=22)
    fingerprint = data.fingerprint()
    assert fingerprint["repeated"] == "40"
    flights = [set(split.fields["flight"].tolist()) for split in data.splits()]
    assert sum(map(len, flights)) + int(fingerprint["too short"]) == 82
    assert not (flights[0] & flights[1] or flights[0] & flights[2] or flights[1] & flights[2])


def _as_cells(arrays: Sequence[np.ndarray]) -> np.ndarray:
    cells = np.empty(len(arrays), object)
    cells[:] = arrays
    return cells


@pytest.mark.parametrize("frames", [[50], [50, 50], [50, 40]], ids=str)
@pytest.mark.parametrize("layout", ["ballTrain", "time and ball"])
def test_a_matlab_file_holds_any_number_of_flights(
    tmp_path: Path, layout: str, frames: Sequence[int]
) -> None:
    tables = [table(number, count) for number, count in enumerate(frames)]
    times, balls = [rows[:, 0] for rows in tables], [rows[:, 1:] for rows in tables]
    together = {"time": _as_cells(times), "ball": _as_cells(balls)}
    savemat(
        tmp_path / "flights.mat",
        {"ballTrain": {"data": _as_cells(tables)}} if layout == "ballTrain" else together,
    )
    flights = flights_of(tmp_path / "flights.mat", 0.016)
    for flight, rows in zip(flights, tables, strict=True):
        np.testing.assert_array_equal(np.column_stack([flight.times, flight.places]), rows)


def test_a_matlab_file_with_more_times_than_positions_is_refused(tmp_path: Path) -> None:
    rows = table(0, 50)
    savemat(tmp_path / "flights.mat", {"time": _as_cells([rows[:, 0]] * 2), "ball": _as_cells([rows[:, 1:]])})
    with pytest.raises(DataError, match=r"`time` holds 2 flights and `ball` holds 1\. Give both one cell"):
        flights_of(tmp_path / "flights.mat", 0.016)


def test_noise_constants_and_stiff_contact_change_the_simulated_flights() -> None:
    small = {"flights": 5, "observed": 6, "future": 4, "least": 4, "stride": 20}
    digests = {prepare_data(**small, **more).fingerprint()["sha256"] for more in (
        {}, {"noise": 0.01}, {"drag": 0.1}, {"contact": "spring"}, {"outliers": 0.2}, {"dropped": 0.3},
    )}  # fmt: skip
    assert len(digests) == 6
