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
TRUE_COLUMNS = ("true_x", "true_y", "true_z")
SUFFIXES = (".csv", ".mat")
TOLERANCE = 1e-4
"""Largest difference of a coordinate, metres, up to which two recordings can be of the same flight."""
COMPARED = 8
"""Number of first frames that are compared to decide whether two recordings are of the same flight."""
LARGEST_STEP = 1.0
"""Largest step between frames, seconds, that data.step allows."""
TimesIn = Literal["seconds", "milliseconds", "microseconds"]
LengthsIn = Literal["metres", "centimetres", "millimetres"]
METRES: dict[LengthsIn, float] = {"metres": 1.0, "centimetres": 1e-2, "millimetres": 1e-3}
SECONDS: dict[TimesIn, float] = {"seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6}
FARTHEST = 100.0
"""Largest plausible coordinate of a ball, metres."""


class Flight(NamedTuple):
    """Times and positions of one flight.

    Attributes:
        name: Name of the file, and the number of the flight if the file holds several.
        times: Increasing times, (frame,), s.
        places: Positions, (frame, 3), m.
        truth: Positions without noise, (frame, 3), m, if the flight was simulated; otherwise None.
    """

    name: str
    times: Float[np.ndarray, "frame"]
    places: Float[np.ndarray, "frame 3"]
    truth: Float[np.ndarray, "frame 3"] | None = None


def list_files(root: Path) -> list[Path]:
    """Return the files of flights in a folder, sorted by name; if `root` is a file, return it.

    Raises:
        DataError: There is no such file or folder, or the folder holds no flight.
    """
    if root.is_file():
        return [root]
    if not root.is_dir():
        raise DataError(
            f"data.root = {root} does not exist. Set data.root to a folder of flights, *.csv with the columns t, x, y, "
            "z or *.mat of the WAM laboratory, or leave it out to simulate flights."
        )
    files = sorted(file for file in root.iterdir() if file.suffix.lower() in SUFFIXES)
    if not files:
        raise DataError(
            f"data.root = {root} holds no *.csv and no *.mat file. Set data.root to a folder of recorded flights."
        )
    return files


def flights_of(
    file: Path,
    step: float,
    times_in: TimesIn = "seconds",
    writing: Writing | None = None,
    lengths_in: LengthsIn = "metres",
) -> list[Flight]:
    """Read the flights of one file; a CSV file holds one flight.

    Args:
        file: The file.
        step: Configured seconds between two frames.
        times_in: Unit of the times in the file.
        writing: Notation of a CSV file; None for the default.
        lengths_in: Unit of the positions in the file.

    Raises:
        DataError: The file is damaged, or times or positions of a flight are wrong; the message names the place.
    """
    if file.suffix.lower() == ".mat":
        recorded = [_to_units(flight, times_in, lengths_in) for flight in _from_matlab(file)]
        return [_check(flight, step, times_in) for flight in recorded]
    columns = read_columns(file, writing)
    require(columns, COLUMNS, f"The layout of a flight ({', '.join(COLUMNS)})")
    times, *positions = (numbers(columns, name, missing="") for name in COLUMNS)
    truth = None
    if all(name in columns.cells for name in TRUE_COLUMNS):
        truth = np.stack([numbers(columns, name, missing="") for name in TRUE_COLUMNS], -1)
    flight = Flight(str(file), times, np.stack(positions, -1), truth)
    return [_check(_to_units(flight, times_in, lengths_in), step, times_in, columns.lines)]


def _to_units(flight: Flight, times_in: TimesIn, lengths_in: LengthsIn) -> Flight:
    """Return the flight with times in seconds and positions in metres."""
    if times_in != "seconds":
        flight = flight._replace(times=flight.times * SECONDS[times_in])
    if lengths_in == "metres":
        return flight
    truth = None if flight.truth is None else flight.truth * METRES[lengths_in]
    return flight._replace(places=flight.places * METRES[lengths_in], truth=truth)


def unread_columns(file: Path, writing: Writing | None) -> list[str]:
    """Return the names of the columns of a CSV file that are not read."""
    if file.suffix.lower() == ".mat":
        return []
    columns = read_columns(file, writing)
    return [*columns.left_out, *(name for name in columns.cells if name not in (*COLUMNS, *TRUE_COLUMNS))]


def _from_matlab(file: Path) -> list[Flight]:
    """Read the flights of a MATLAB file, which has one of two layouts.

    `ballTrain.data` holds one cell (frame, 4) for each flight; or `time` holds cells (frame,) and `ball` cells
    (frame, 3).
    """
    variables = read_variables(file)
    training: Any = variables.get("ballTrain")
    if isinstance(training, Mapping) and "data" in training:
        tables = [to_real(cell, "a flight") for cell in _split_cells(training["data"])]
    elif "time" in variables and "ball" in variables:
        times, balls = _split_cells(variables["time"]), _split_cells(variables["ball"])
        if len(times) != len(balls):
            raise DataError(
                f"{file}: The variable `time` holds {len(times)} flights and `ball` holds {len(balls)}. "
                "Give both one cell for each flight."
            )
        tables = [_join(time, ball) for time, ball in zip(times, balls, strict=True)]
    else:
        raise DataError(
            f"{file} holds {shorten(', '.join(variables)) or 'nothing'}, but the variable `ballTrain` with a "
            "field `data`, or the variables `time` and `ball`, are expected, as in the files of the WAM laboratory. "
            "Give such a file, or write each flight as CSV with the columns t, x, y, z."
        )
    for number, table in enumerate(tables):
        if table.ndim != 2 or table.shape[1] != 4:
            raise DataError(
                f"{file} flight {number}: The flight is an array of {'×'.join(map(str, table.shape))} numbers; "
                "expected rows of t, x, y, z. Remove the flight."
            )
    return [
        Flight(f"{file} flight {number}", table[:, 0], table[:, 1:]) for number, table in enumerate(tables)
    ]


def _split_cells(variable: Any) -> list[Any]:
    """Return the cells of a variable; an array of numbers is one cell, because the reader drops axes of length 1."""
    array = np.asarray(variable)
    return list(array.reshape(-1)) if array.dtype == object else [array]


def _join(time: Any, ball: Any) -> np.ndarray:
    """Return the columns t, x, y, z of a flight; if time and positions do not fit together, the positions alone."""
    time, ball = np.atleast_1d(to_real(time, "time")), np.atleast_2d(to_real(ball, "ball"))
    same = time.ndim == 1 and ball.ndim == 2 and len(time) == len(ball)
    return np.column_stack([time, ball]) if same else ball


def _check(
    flight: Flight, step: float, times_in: TimesIn = "seconds", lines: Sequence[int] | None = None
) -> Flight:
    """Return the flight unchanged, after checking it.

    Args:
        flight: The flight, with times in seconds.
        step: Configured seconds between two frames.
        times_in: Unit of the times in the file, for messages.
        lines: Line of each frame in the file, if the file has lines.

    Raises:
        DataError: The flight has fewer than two frames; a number is not finite or too large; times do not increase; or
            the frames have another rate than `step`.
    """
    name, times, positions, _ = flight

    def frame_name(row: int) -> str:
        return f"{name} line {lines[row]}" if lines else f"{name}, frame {row}"

    if len(times) < 2:
        raise DataError(f"{name} has {len(times)} frames, but at least two are required. Remove the flight.")
    wrong = ~(np.isfinite(times) & (np.abs(positions) <= FARTHEST).all(1))
    if wrong.any():
        row = int(wrong.argmax())
        coordinates = ", ".join(f"{value:g}" for value in positions[row])
        raise DataError(
            f"{frame_name(row)}: t, x, y, z = {times[row]:g}, {coordinates}; expected seconds, and metres within "
            f"{FARTHEST:g} of the origin. Correct the frame or remove it{_unit_hint(positions)}."
        )
    gaps = np.diff(times)
    if (gaps <= 0).any():
        row = int((gaps <= 0).argmax()) + 1
        raise DataError(
            f"{frame_name(row)}: The time {times[row]:g} s comes after {times[row - 1]:g} s, but times must increase. "
            "Sort the frames, or remove repeated ones."
        )
    usual = float(np.median(gaps))
    if not 0.6 < usual / step < 1.6:
        raise DataError(
            f"{name} has a frame every {1000 * usual:.4g} ms if its times are in {times_in}, but data.step is "
            f"{1000 * step:.3g} ms. {_rate_remedy(usual, step, times_in)}"
        )
    return flight


def _rate_remedy(usual: float, step: float, times_in: TimesIn) -> str:
    """Return the advice for a flight whose frames have another rate than `step`.

    Args:
        usual: Median time between two frames, s, if the times in the file are in `times_in`.
        step: Configured seconds between two frames.
        times_in: Configured unit of the times.
    """
    for unit, seconds in SECONDS.items():
        if unit != times_in and 0.6 < usual / SECONDS[times_in] * seconds / step < 1.6:
            return f"Set data.times_in={unit}."
    if 0 < usual <= LARGEST_STEP:
        return f"Set data.step={usual:.4g}."
    return f"Frames must be at most {LARGEST_STEP:g} s apart. Correct the times, or set data.times_in to their unit."


def _unit_hint(positions: Float[np.ndarray, "frame 3"]) -> str:
    """Return advice about the unit if most positions are too large for metres, otherwise an empty text."""
    usual = float(np.median(np.abs(positions).max(1)))
    return (
        "; set data.lengths_in to millimetres or centimetres if positions are in this unit"
        if usual > FARTHEST
        else ""
    )


def drop_repeated(flights: Sequence[Flight]) -> tuple[list[Flight], int]:
    """Return the flights without repetitions, in their order, and the number of repetitions.

    Recordings that begin with the same positions are of the same flight; the longest recording is returned.
    """
    longest: list[Flight] = []
    for flight in sorted(flights, key=lambda recording: -len(recording.times)):
        if not any(_same(flight, other) for other in longest):
            longest.append(flight)
    chosen = {id(flight) for flight in longest}
    return [flight for flight in flights if id(flight) in chosen], len(flights) - len(longest)


def _same(first: Flight, second: Flight) -> bool:
    """Return whether two recordings begin with the same positions."""
    count = min(len(first.places), len(second.places), COMPARED)
    return bool((np.abs(first.places[:count] - second.places[:count]) <= TOLERANCE).all())


def count_missing_frames(flight: Flight, step: float) -> int:
    """Return how many frames are missing, according to the times of the other frames.

    `step` is the time from frame to frame, s.
    """
    return int(np.maximum(np.rint(np.diff(flight.times) / step) - 1, 0).sum())
