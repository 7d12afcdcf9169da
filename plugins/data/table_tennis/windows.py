"""Windows of a flight: the frames until now, which a model reads, and the positions at fixed later times."""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field

from framework.flights.frames import GRAVITY, PARTS, future_names
from plugins.data.table_tennis.recordings import Flight


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Frames of a flight that are read and predicted.

    Attributes:
        observed: largest number of frames that are read; earlier ones are dropped.
        future: number of frames that are predicted.
        least: number of frames that must be present among those that are read.
        stride: frames from one window of a flight to the next.
        step: seconds from frame to frame.
        gap: longest time between two frames, seconds, across which a position to predict may be interpolated; a window
            with a wider gap in its future is left out.
        outlier: distance, metres, from the position that its neighbours suggest, beyond which a frame is not used as a
            target. It is still read.
    """

    observed: Annotated[int, Field(ge=3, le=1000)] = 20
    future: Annotated[int, Field(ge=1, le=1000)] = 35
    least: Annotated[int, Field(ge=3, le=1000)] = 8
    stride: Annotated[int, Field(ge=1, le=1000)] = 4
    step: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = 0.016
    gap: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = 0.04
    outlier: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.12

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers that are predicted."""
        return future_names(self.future, self.step)


class Window(NamedTuple):
    """One sample: input (observed × 5,), target and target without noise (future × 3,), and its frame in the flight."""

    inputs: Float[np.ndarray, "number"]
    target: Float[np.ndarray, "number"]
    truth: Float[np.ndarray, "number"]
    frame: int


def prefix(flight: Flight, now: int, grid: Grid) -> Float[np.ndarray, "number"] | None:
    """Return the input at frame `now`; None where fewer frames than `least` are present.

    Each frame is put at the nearest multiple of `step` before now. If two frames have the same place, the nearer one
    takes it.
    """
    since = flight.times[: now + 1] - flight.times[now]
    place = np.rint(since / grid.step).astype(int)
    near = np.abs(since - place * grid.step)
    read = np.zeros((grid.observed, len(PARTS)))
    for frame in np.argsort(-near, kind="stable"):
        slot = grid.observed - 1 + place[frame]
        if slot >= 0:
            read[slot] = [since[frame], *flight.places[frame], 1]
    return read.ravel() if read[:, -1].sum() >= grid.least else None


def windows(flight: Flight, grid: Grid) -> list[Window]:
    """Return the windows of a flight, every `stride` frames; an empty list for a flight that is too short."""
    good = believed(flight, grid.outlier)
    times, places = flight.times[good], flight.places[good]
    truth = places if flight.truth is None else flight.truth[good]
    found = []
    for now in range(grid.least - 1, len(flight.times), grid.stride):
        inputs = prefix(flight, now, grid)
        asked = flight.times[now] + grid.step * np.arange(1, grid.future + 1)
        after = np.searchsorted(times, asked)
        if inputs is None or after[-1] >= len(times) or after[0] == 0:
            continue
        if (times[after] - times[after - 1]).max() > grid.gap:
            continue
        target, exact = (between(times, some, asked, after).ravel() for some in (places, truth))
        found.append(Window(inputs, target, exact, now))
    return found


def between(
    times: Float[np.ndarray, "frame"],
    places: Float[np.ndarray, "frame 3"],
    asked: Float[np.ndarray, "time"],
    after: np.ndarray,
) -> Float[np.ndarray, "time 3"]:
    """Return the places at the requested times: linear between two frames, and in z on the parabola of a free fall."""
    left, right = times[after - 1], times[after]
    share = ((asked - left) / (right - left))[:, None]
    found = (1 - share) * places[after - 1] + share * places[after]
    found[:, 2] += GRAVITY / 2 * (asked - left) * (right - asked)
    return found


def believed(flight: Flight, farthest: float) -> Bool[np.ndarray, "frame"]:
    """Return a mask of the frames that are not outliers.

    While a frame is farther than `farthest` metres from the position that its neighbours suggest, the worst frame is
    removed. The first and the last frame have only one neighbour and stay.
    """
    kept = np.arange(len(flight.times))
    while len(kept) > 2:
        times, places = flight.times[kept], flight.places[kept]
        share = ((times[1:-1] - times[:-2]) / (times[2:] - times[:-2]))[:, None]
        straight = (1 - share) * places[:-2] + share * places[2:]
        straight[:, 2] += GRAVITY / 2 * (times[1:-1] - times[:-2]) * (times[2:] - times[1:-1])
        apart = np.linalg.norm(places[1:-1] - straight, axis=1)
        if apart.max() <= farthest:
            break
        kept = np.delete(kept, int(apart.argmax()) + 1)
    good = np.zeros(len(flight.times), bool)
    good[kept] = True
    return good
