"""Compiled fits of parabolas to the last recorded positions of balls, without outliers, and features of the fits."""

from pathlib import Path
from typing import no_type_check

import numpy as np

from framework.storage.kernels import compiler, kernel_cache

compiled = compiler(kernel_cache("parabolas", [Path(__file__)]))
OUTLIER_LIMIT, MOST_OUTLIERS = 5.0, 2
"""Criterion of a fit: frames farther than OUTLIER_LIMIT standard deviations from the parabola are outliers.

A parabola fits a span of frames if at most MOST_OUTLIERS of them are outliers.
"""
ROUNDS = 8
"""Number of alternating updates of weights and parabola."""
PRIOR_DEVIATIONS = (10.0, 10.0, 4.0)
"""Prior standard deviations of position, velocity and acceleration beyond gravity: m, m/s, m/s²."""


@compiled
@no_type_check
def factorise(matrix):
    """Replace the lower triangle of a positive definite 3 × 3 matrix by its Cholesky factor."""
    for row in range(3):
        for column in range(row + 1):
            total = matrix[row, column]
            for inner in range(column):
                total -= matrix[row, inner] * matrix[column, inner]
            matrix[row, column] = np.sqrt(total) if row == column else total / matrix[column, column]


@compiled
@no_type_check
def solve(triangle, right):
    """Solve L Lᵀ X = `right` for X, (3, columns), where L is the lower triangle `triangle`; X overwrites `right`."""
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
def fit_parabolas(times, positions, visible, spans, noise, long, short, covariance, span):
    """Fit parabolas to the last frames, by least squares with Cauchy's weights (Holland & Welsch 1977).

    Args:
        times: (flight, frame), s.
        positions: (flight, frame, 3), m; any number where the ball was not seen.
        visible: (flight, frame), whether the ball was seen.
        spans: numbers of last frames that are fitted, the largest first.
        noise: standard deviation of the measurement error of each coordinate, m.
        long: filled with the coefficients of 1, t and t²/2, (flight, 3, axis), of the parabola through the longest
            span that a parabola fits.
        short: filled with the coefficients of the last (shortest) span, in the same form.
        covariance: filled with the covariance of an axis's coefficients of `long`, (flight, 3, 3).
        span: filled with the index of the span of `long`, (flight,).
    """
    count = times.shape[1]
    power, weight, distance = np.empty((count, 3)), np.empty(count), np.empty(count)
    precision = np.empty((3, 3))
    for flight in range(times.shape[0]):
        chosen = False
        power[:, 0] = 1.0
        power[:, 1] = times[flight]
        power[:, 2] = times[flight] ** 2 / 2
        for number in range(len(spans)):
            first = count - spans[number]
            weight[:] = 1.0
            coefficients = short[flight]
            for iteration in range(ROUNDS):
                precision[:] = 0.0
                coefficients[:] = 0.0
                for row in range(3):
                    precision[row, row] = 1 / PRIOR_DEVIATIONS[row] ** 2
                for frame in range(first, count):
                    if visible[flight, frame]:
                        share = weight[frame] / noise**2
                        for row in range(3):
                            for column in range(3):
                                precision[row, column] += share * power[frame, row] * power[frame, column]
                                coefficients[row, column] += (
                                    share * power[frame, row] * positions[flight, frame, column]
                                )
                factorise(precision)
                solve(precision, coefficients)
                # wide at first, so that the first parabola does not decide which frames are outliers
                width = 3 * 3.0 ** max(0, 4 - iteration)
                outliers = 0
                for frame in range(first, count):
                    if visible[flight, frame]:
                        square = 0.0
                        for axis in range(3):
                            residual = positions[flight, frame, axis]
                            for row in range(3):
                                residual -= power[frame, row] * coefficients[row, axis]
                            square += residual * residual
                        distance[frame] = np.sqrt(square) / noise
                        weight[frame] = 1 / (1 + (distance[frame] / width) ** 2)
                        outliers += distance[frame] > OUTLIER_LIMIT
            if not chosen and (outliers <= MOST_OUTLIERS or number == len(spans) - 1):
                chosen = True
                span[flight] = number
                long[flight] = coefficients
                covariance[flight] = 0.0
                for row in range(3):
                    covariance[flight, row, row] = 1.0
                solve(precision, covariance[flight])


@compiled
@no_type_check
def fill_features(times, positions, visible, gravity, spans, noise, speed, growth, moments, features):
    """Fill `features` with the numbers that `extrapolation.ExtrapolationEncoder` returns for each flight.

    Args:
        times: (flight, frame), s.
        positions: (flight, frame, 3), m; any number where the ball was not seen.
        visible: (flight, frame), whether the ball was seen.
        gravity: acceleration of a falling ball, m/s².
        spans: numbers of last frames to which parabolas are fitted, the largest first.
        noise: standard deviation of the measurement error of each coordinate, m.
        speed: growth of the unit of x, y and z with time, (3,), m/s, as `extrapolation.SPEED`.
        growth: growth of the unit with the square of time, (3,), m/s², as `extrapolation.GROWTH`.
        moments: times at which the ball is predicted, (future,), s.
        features: filled with the features, (flight, length of the features).
    """
    flights, count = times.shape
    without_gravity = positions.copy()
    for flight in range(flights):
        for frame in range(count):
            without_gravity[flight, frame, 2] += gravity / 2 * times[flight, frame] ** 2
    long, short = np.empty((flights, 3, 3)), np.empty((flights, 3, 3))
    covariance, span = np.empty((flights, 3, 3)), np.empty(flights, np.int64)
    fit_parabolas(times, without_gravity, visible, spans, noise, long, short, covariance, span)
    power = np.empty(3)
    power[0] = 1.0
    for flight in range(flights):
        values = features[flight]
        index = 0
        for moment in moments:
            power[1], power[2] = moment, moment**2 / 2
            for axis in range(3):
                total = -gravity * power[2] if axis == 2 else 0.0
                for row in range(3):
                    total += power[row] * long[flight, row, axis]
                values[index] = min(max(total, -100.0), 100.0)
                values[index + 3 * len(moments)] = np.log(
                    noise + speed[axis] * moment + growth[axis] * moment**2
                )
                index += 1
        index *= 2
        for parabola in (long, short):
            for row in range(3):
                for axis in range(3):
                    values[index] = parabola[flight, row, axis] / 5
                    index += 1
        values[index : index + len(spans)] = 0.0
        values[index + span[flight]] = 1.0
        index += len(spans)
        for moment in (moments[0], moments[-1]):
            power[1], power[2] = moment, moment**2 / 2
            total = 0.0
            for row in range(3):
                for column in range(3):
                    total += power[row] * covariance[flight, row, column] * power[column]
            values[index] = np.log(total) / 6
            index += 1
        # Residuals on a fine and a coarse scale: after a bounce the path is metres from the parabola, while the noise
        # of a frame is millimetres.
        for frame in range(count):
            power[1], power[2] = times[flight, frame], times[flight, frame] ** 2 / 2
            for axis in range(3):
                residual = 0.0
                if visible[flight, frame]:
                    residual = without_gravity[flight, frame, axis]
                    for row in range(3):
                        residual -= power[row] * long[flight, row, axis]
                values[index + 3 * frame + axis] = np.tanh(residual / (2 * noise))
                values[index + 3 * count + 3 * frame + axis] = np.tanh(residual / 0.1)
            values[index + 6 * count + frame] = 1.0 if visible[flight, frame] else 0.0
        for index in range(len(values)):
            values[index] = min(max(values[index], -1e4), 1e4)
