"""Windows of a flight: the frames up to a moment, which a model reads, and the positions at fixed later times."""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field

from framework.flights.frames import GRAVITY, PARTS, future_names
from plugins.data.table_tennis.recordings import Flight


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Settings of the frames of a flight that are read and predicted.

    Attributes:
        observed: Largest number of frames that are read; earlier frames are not read.
        future: Number of frames that are predicted.
        least: Smallest number of frames that must be present among those that are read.
        stride: Number of frames from one window of a flight to the next.
        step: Seconds from frame to frame.
        gap: Largest time between two frames, seconds, across which a target is interpolated; a window with a wider gap
            in its future is left out.
        outlier: Distance, metres, between a frame and the position that its neighbours suggest, above which the frame
            is not used as a target. The model still reads the frame.
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
    """One sample: some observed frames of a flight, and the positions of the ball that follow.

    Attributes:
        inputs: The five numbers (`PARTS`) of each observed frame, (observed × 5,).
        target: Measured x, y, z of the ball at each future time, (future × 3,), metres.
        truth: The same positions without measurement noise, (future × 3,), metres.
        frame: Index of the last observed frame in the recording.
    """

    inputs: Float[np.ndarray, "number"]
    target: Float[np.ndarray, "number"]
    truth: Float[np.ndarray, "number"]
    frame: int


def prefix(flight: Flight, now: int, grid: Grid) -> Float[np.ndarray, "number"] | None:
    """Return a model's input at frame `now`; None if fewer than `grid.least` frames are present.

    The grid consists of the times of frame `now` and 1, 2, 3, … steps of `grid.step` before it. Each frame is assigned
    to the grid time that is nearest to its own time. If several frames are assigned to the same grid time, the nearest
    of them is used.
    """
    since = flight.times[: now + 1] - flight.times[now]
    steps = np.rint(since / grid.step).astype(int)
    distance = np.abs(since - steps * grid.step)
    frames = np.zeros((grid.observed, len(PARTS)))
    for frame in np.argsort(-distance, kind="stable"):
        slot = grid.observed - 1 + steps[frame]
        if slot >= 0:
            frames[slot] = [since[frame], *flight.places[frame], 1]
    return frames.ravel() if frames[:, -1].sum() >= grid.least else None


def windows(flight: Flight, grid: Grid) -> list[Window]:
    """Return the windows of a flight, one every `stride` frames; an empty list if the flight is too short."""
    good = is_no_outlier(flight, grid.outlier)
    times, positions = flight.times[good], flight.places[good]
    truth = positions if flight.truth is None else flight.truth[good]
    result = []
    for now in range(grid.least - 1, len(flight.times), grid.stride):
        inputs = prefix(flight, now, grid)
        target_times = flight.times[now] + grid.step * np.arange(1, grid.future + 1)
        after = np.searchsorted(times, target_times)
        if inputs is None or after[-1] >= len(times) or after[0] == 0:
            continue
        if (times[after] - times[after - 1]).max() > grid.gap:
            continue
        target, exact = (
            interpolate(times, values, target_times, after).ravel() for values in (positions, truth)
        )
        result.append(Window(inputs, target, exact, now))
    return result


def interpolate(
    times: Float[np.ndarray, "frame"],
    positions: Float[np.ndarray, "frame 3"],
    target_times: Float[np.ndarray, "time"],
    after: np.ndarray,
) -> Float[np.ndarray, "time 3"]:
    """Return the positions at the target times, interpolated between the frames before and after each of them.

    x and y are interpolated linearly; z follows the parabola of a free fall.

    Args:
        times: Times of the frames, s.
        positions: Positions of the frames, m.
        target_times: Target times, s.
        after: Index of the first frame at or after each target time.
    """
    left, right = times[after - 1], times[after]
    share = ((target_times - left) / (right - left))[:, None]
    interpolated = (1 - share) * positions[after - 1] + share * positions[after]
    interpolated[:, 2] += GRAVITY / 2 * (target_times - left) * (right - target_times)
    return interpolated


def is_no_outlier(flight: Flight, farthest: float) -> Bool[np.ndarray, "frame"]:
    """Return a mask of the frames that are not outliers.

    While a frame is farther than `farthest` metres from the position that its neighbours suggest, the worst frame is
    removed. The first and the last frame have only one neighbour and are never removed.
    """
    remaining = np.arange(len(flight.times))
    while len(remaining) > 2:
        times, positions = flight.times[remaining], flight.places[remaining]
        share = ((times[1:-1] - times[:-2]) / (times[2:] - times[:-2]))[:, None]
        expected = (1 - share) * positions[:-2] + share * positions[2:]
        expected[:, 2] += GRAVITY / 2 * (times[1:-1] - times[:-2]) * (times[2:] - times[1:-1])
        distance = np.linalg.norm(positions[1:-1] - expected, axis=1)
        if distance.max() <= farthest:
            break
        remaining = np.delete(remaining, int(distance.argmax()) + 1)
    mask = np.zeros(len(flight.times), bool)
    mask[remaining] = True
    return mask
