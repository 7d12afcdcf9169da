"""Robust parabolas through the last frames of flights, and features of them, on one CPU core; on NumPy arrays."""

from pathlib import Path
from typing import no_type_check

import numpy as np

from framework.storage.kernels import compiler, kernel_cache

compiled = compiler(kernel_cache("parabolas", [Path(__file__)]))
FITS, STRANGE = 5.0, 2
"""Criterion of a fit: frames farther than FITS standard deviations are outliers, of which it has at most STRANGE."""
ROUNDS = 8
"""Number of alternating updates of weights and parabola."""
BELIEF = (10.0, 10.0, 4.0)
"""Prior standard deviations of position, velocity and acceleration beyond gravity: m, m/s, m/s²."""


@compiled
@no_type_check
def factored(matrix):
    """Compute Cholesky's lower triangle of a positive definite 3 × 3 matrix in place."""
    for row in range(3):
        for column in range(row + 1):
            total = matrix[row, column]
            for inner in range(column):
                total -= matrix[row, inner] * matrix[column, inner]
            matrix[row, column] = np.sqrt(total) if row == column else total / matrix[column, column]


@compiled
@no_type_check
def solved(triangle, right):
    """Solve L Lᵀ X = right (3, columns) in place."""
    for column in range(right.shape[1]):
        for row in range(3):
            for inner in range(row):
                right[row, column] -= triangle[row, inner] * right[inner, column]
            right[row, column] /= triangle[row, row]
        for row in range(2, -1, -1):
            for inner in range(row + 1, 3):
                right[row, column] -= triangle[inner, row] * right[inner, column]
            right[row, column] /= triangle[row, row]


@compiled
@no_type_check
def parabolas(times, places, there, spans, noise, long, short, spread, span):
    """Fit parabolas to the last frames, by least squares with Cauchy's weights (Holland & Welsch 1977).

    Args:
        times: (flight, frame), s.
        places: positions (flight, frame, 3), m; any number where the ball was not seen.
        there: (flight, frame), whether the ball was seen.
        spans: numbers of last frames that are fitted, the largest first.
        noise: standard deviation of a coordinate, m.
        long: filled with the coefficients of 1, t and t²/2 (flight, 3, axis) of the longest span that fits.
        short: filled with the coefficients of the last span.
        spread: filled with the covariance of an axis's coefficients of `long`, (flight, 3, 3).
        span: filled with the index of the span of `long`, (flight,).
    """
    count = times.shape[1]
    power, weight, apart = np.empty((count, 3)), np.empty(count), np.empty(count)
    precision = np.empty((3, 3))
    for flight in range(times.shape[0]):
        chosen = False
        power[:, 0] = 1.0
        power[:, 1] = times[flight]
        power[:, 2] = times[flight] ** 2 / 2
        for number in range(len(spans)):
            first = count - spans[number]
            weight[:] = 1.0
            found = short[flight]
            for turn in range(ROUNDS):
                precision[:] = 0.0
                found[:] = 0.0
                for row in range(3):
                    precision[row, row] = 1 / BELIEF[row] ** 2
                for frame in range(first, count):
                    if there[flight, frame]:
                        share = weight[frame] / noise**2
                        for row in range(3):
                            for column in range(3):
                                precision[row, column] += share * power[frame, row] * power[frame, column]
                                found[row, column] += (
                                    share * power[frame, row] * places[flight, frame, column]
                                )
                factored(precision)
                solved(precision, found)
                # wide at first, so that the first parabola does not decide which frames are outliers
                width = 3 * 3.0 ** max(0, 4 - turn)
                strange = 0
                for frame in range(first, count):
                    if there[flight, frame]:
                        square = 0.0
                        for axis in range(3):
                            off = places[flight, frame, axis]
                            for row in range(3):
                                off -= power[frame, row] * found[row, axis]
                            square += off * off
                        apart[frame] = np.sqrt(square) / noise
                        weight[frame] = 1 / (1 + (apart[frame] / width) ** 2)
                        strange += apart[frame] > FITS
            if not chosen and (strange <= STRANGE or number == len(spans) - 1):
                chosen = True
                span[flight] = number
                long[flight] = found
                spread[flight] = 0.0
                for row in range(3):
                    spread[flight, row, row] = 1.0
                solved(precision, spread[flight])


@compiled
@no_type_check
def described(times, places, there, gravity, spans, noise, speed, growth, moments, features):
    """Fill `features` (flight, number) with the features of flights that `extrapolation.ExtrapolationEncoder` returns.

    Args:
        times: see `parabolas`.
        places: see `parabolas`.
        there: see `parabolas`.
        gravity: m/s².
        spans: see `parabolas`.
        noise: see `parabolas`.
        speed: growth of the unit with time, (3,), m/s.
        growth: growth of the unit with the square of time, (3,), m/s².
        moments: times at which the ball is predicted, (future,), s.
        features: filled, (flight, number).
    """
    flights, count = times.shape
    fallen = places.copy()  # positions without the effect of gravity
    for flight in range(flights):
        for frame in range(count):
            fallen[flight, frame, 2] += gravity / 2 * times[flight, frame] ** 2
    long, short = np.empty((flights, 3, 3)), np.empty((flights, 3, 3))
    spread, span = np.empty((flights, 3, 3)), np.empty(flights, np.int64)
    parabolas(times, fallen, there, spans, noise, long, short, spread, span)
    power = np.empty(3)
    power[0] = 1.0
    for flight in range(flights):
        found = features[flight]
        place = 0
        for moment in moments:
            power[1], power[2] = moment, moment**2 / 2
            for axis in range(3):
                total = -gravity * power[2] if axis == 2 else 0.0
                for row in range(3):
                    total += power[row] * long[flight, row, axis]
                found[place] = min(max(total, -100.0), 100.0)
                found[place + 3 * len(moments)] = np.log(
                    noise + speed[axis] * moment + growth[axis] * moment**2
                )
                place += 1
        place *= 2
        for parabola in (long, short):
            for row in range(3):
                for axis in range(3):
                    found[place] = parabola[flight, row, axis] / 5
                    place += 1
        found[place : place + len(spans)] = 0.0
        found[place + span[flight]] = 1.0
        place += len(spans)
        for moment in (moments[0], moments[-1]):
            power[1], power[2] = moment, moment**2 / 2
            total = 0.0
            for row in range(3):
                for column in range(3):
                    total += power[row] * spread[flight, row, column] * power[column]
            found[place] = np.log(total) / 6
            place += 1
        # Residuals on a fine and a coarse scale: after a bounce the path is metres from the parabola, while the noise
        # of a frame is millimetres.
        for frame in range(count):
            power[1], power[2] = times[flight, frame], times[flight, frame] ** 2 / 2
            for axis in range(3):
                off = 0.0
                if there[flight, frame]:
                    off = fallen[flight, frame, axis]
                    for row in range(3):
                        off -= power[row] * long[flight, row, axis]
                found[place + 3 * frame + axis] = np.tanh(off / (2 * noise))
                found[place + 3 * count + 3 * frame + axis] = np.tanh(off / 0.1)
            found[place + 6 * count + frame] = 1.0 if there[flight, frame] else 0.0
        for place in range(len(found)):
            found[place] = min(max(found[place], -1e4), 1e4)
