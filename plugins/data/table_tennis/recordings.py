"""Reading and checking of recorded flights, from CSV files and from MATLAB files of the WAM laboratory."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from framework.datasets.csv_columns import Writing, numbers, read_columns, require
from framework.datasets.matlab import read_variables
from framework.errors import DataError, shorten
from framework.storage.arrays import to_real

COLUMNS = ("t", "x", "y", "z")
TRUE = ("true_x", "true_y", "true_z")
SUFFIXES = (".csv", ".mat")
ALIKE = 1e-4
"""Greatest difference, metres, of frames of one flight in two recordings."""
COMPARED = 8
"""Number of first frames by which two recordings of one flight are recognised."""
SLOWEST = 1.0
"""Largest step between frames, seconds, that data.step allows."""
TimesIn = Literal["seconds", "milliseconds", "microseconds"]
SECONDS: dict[TimesIn, float] = {"seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6}
FARTHEST = 100.0
"""Greatest plausible distance of a ball from the origin, metres."""


class Flight(NamedTuple):
    """Times and positions of one flight.

    Attributes:
        name: the file, and the flight's number in it where it holds several.
        times: (frame,), s, rising.
        places: (frame, 3), m.
        truth: positions without noise, (frame, 3), m, where the flight was simulated; otherwise None.
    """

    name: str
    times: Float[np.ndarray, "frame"]
    places: Float[np.ndarray, "frame 3"]
    truth: Float[np.ndarray, "frame 3"] | None = None


def listed(root: Path) -> list[Path]:
    """Return the files of flights in a folder, sorted by name; or the file itself.

    Raises:
        DataError: there is no such file or folder, or the folder has no flight.
    """
    if root.is_file():
        return [root]
    if not root.is_dir():
        raise DataError(
            f"{root}: no such file or folder; wanted a folder of flights, *.csv with the columns t, x, y, z or *.mat "
            "of the WAM laboratory. Mend data.root, or leave it out: flights are simulated then."
        )
    found = sorted(file for file in root.iterdir() if file.suffix.lower() in SUFFIXES)
    if not found:
        raise DataError(f"{root} holds no *.csv and no *.mat file; wanted recorded flights. Mend data.root.")
    return found


def flights_of(
    file: Path, step: float, times_in: TimesIn = "seconds", writing: Writing | None = None
) -> list[Flight]:
    """Read the flights of one file: one from a CSV file, all from a MATLAB file.

    Args:
        file: the file.
        step: seconds between two frames, as the configuration says.
        times_in: the unit of the file's times.
        writing: how a CSV file is written.

    Raises:
        DataError: the file is damaged, or a flight's times or places are wrong; the message says which and where.
    """
    if file.suffix.lower() == ".mat":
        return [_checked(_in_seconds(flight, times_in), step, times_in) for flight in _from_matlab(file)]
    columns = read_columns(file, writing)
    require(columns, COLUMNS, "data.root")
    times, *places = (numbers(columns, name, missing="") for name in COLUMNS)
    truth = None
    if all(name in columns.cells for name in TRUE):
        truth = np.stack([numbers(columns, name, missing="") for name in TRUE], -1)
    flight = Flight(str(file), times, np.stack(places, -1), truth)
    return [_checked(_in_seconds(flight, times_in), step, times_in, columns.lines)]


def _in_seconds(flight: Flight, times_in: TimesIn) -> Flight:
    return flight if times_in == "seconds" else flight._replace(times=flight.times * SECONDS[times_in])


def other_columns(file: Path, writing: Writing | None) -> list[str]:
    """Return the names of the columns of a CSV file that do not belong to a flight."""
    if file.suffix.lower() == ".mat":
        return []
    columns = read_columns(file, writing)
    return [*columns.left_out, *(name for name in columns.cells if name not in (*COLUMNS, *TRUE))]


def _from_matlab(file: Path) -> list[Flight]:
    """Read `ballTrain.data` of cells (frame, 4), or `time` and `ball` of cells (frame,) and (frame, 3)."""
    found = read_variables(file)
    held: Any = found.get("ballTrain")
    if isinstance(held, Mapping) and "data" in held:
        tables = [to_real(one, "a flight") for one in np.atleast_1d(held["data"])]
    elif "time" in found and "ball" in found:
        pairs = zip(np.atleast_1d(found["time"]), np.atleast_1d(found["ball"]), strict=False)
        tables = [_joined(time, ball) for time, ball in pairs]
    else:
        raise DataError(
            f"{file} holds {shorten(', '.join(found)) or 'nothing'}; wanted ballTrain with a field data, or time and "
            "ball, as the WAM laboratory's flights. Or write each flight as CSV with the columns t, x, y, z."
        )
    for number, table in enumerate(tables):
        if table.ndim != 2 or table.shape[1] != 4:
            raise DataError(
                f"{file} flight {number}: an array of {'×'.join(map(str, table.shape))} numbers; wanted rows of t, x, "
                "y, z. Take the flight out."
            )
    return [Flight(f"{file} flight {number}", one[:, 0], one[:, 1:]) for number, one in enumerate(tables)]


def _joined(time: Any, ball: Any) -> np.ndarray:
    time, ball = np.atleast_1d(to_real(time, "time")), np.atleast_2d(to_real(ball, "ball"))
    same = time.ndim == 1 and ball.ndim == 2 and len(time) == len(ball)
    return np.column_stack([time, ball]) if same else ball


def _checked(
    flight: Flight, step: float, times_in: TimesIn = "seconds", lines: Sequence[int] | None = None
) -> Flight:
    """Return the flight unchanged, after checking it.

    Raises:
        DataError: the flight has fewer than two frames; a number is not finite, or far from any table; times do not
            rise; or the frames have another rate than `step`.
    """
    name, times, places, _ = flight

    def where(row: int) -> str:
        return f"{name} line {lines[row]}" if lines else f"{name}, frame {row}"

    if len(times) < 2:
        raise DataError(f"{name} has {len(times)} frames; wanted two or more. Take the flight out.")
    wrong = ~(np.isfinite(times) & (np.abs(places) <= FARTHEST).all(1))
    if wrong.any():
        row = int(wrong.argmax())
        raise DataError(
            f"{where(row)}: t, x, y, z = {times[row]:g}, {', '.join(f'{one:g}' for one in places[row])}; wanted "
            f"seconds, and metres within {FARTHEST:g} of the origin. Mend the frame or take it out"
            f"{_millimetres(places)}."
        )
    gaps = np.diff(times)
    if (gaps <= 0).any():
        row = int((gaps <= 0).argmax()) + 1
        raise DataError(
            f"{where(row)}: the time {times[row]:g} s comes after {times[row - 1]:g} s; wanted times that rise. Sort "
            "the frames, or take repeated ones out."
        )
    usual = float(np.median(gaps))
    if not 0.6 < usual / step < 1.6:
        raise DataError(
            f"{name} has a frame every {1000 * usual:.4g} ms where its times are {times_in}; data.step says one every "
            f"{1000 * step:.3g} ms. {_other_rate(usual, step, times_in)}"
        )
    return flight


def _other_rate(usual: float, step: float, times_in: TimesIn) -> str:
    """Return the advice for frames that are `usual` seconds apart."""
    for unit, seconds in SECONDS.items():
        if unit != times_in and 0.6 < usual / SECONDS[times_in] * seconds / step < 1.6:
            return f"Set data.times_in={unit}."
    if 0 < usual <= SLOWEST:
        return f"Set data.step={usual:.4g}."
    return f"Frames are at most {SLOWEST:g} s apart, in seconds or in data.times_in. Mend the times."


def _millimetres(places: Float[np.ndarray, "frame 3"]) -> str:
    usual = float(np.median(np.abs(places).max(1)))
    return "; divide all of them by 1000 if they are millimetres" if usual > FARTHEST else ""


def distinct(flights: Sequence[Flight]) -> tuple[list[Flight], int]:
    """Return the flights without repetitions, in their order, and the number of repetitions.

    Flights that begin with the same places are one flight, wherever they are recorded; the longest recording is kept.
    """
    kept: list[Flight] = []
    for flight in sorted(flights, key=lambda one: -len(one.times)):
        if not any(_same(flight, other) for other in kept):
            kept.append(flight)
    chosen = {id(flight) for flight in kept}
    return [flight for flight in flights if id(flight) in chosen], len(flights) - len(kept)


def _same(one: Flight, other: Flight) -> bool:
    count = min(len(one.places), len(other.places), COMPARED)
    return bool((np.abs(one.places[:count] - other.places[:count]) <= ALIKE).all())


def irregular(flight: Flight, step: float) -> int:
    """Return how many frames are missing, according to the times of the others."""
    return int(np.maximum(np.rint(np.diff(flight.times) / step) - 1, 0).sum())
