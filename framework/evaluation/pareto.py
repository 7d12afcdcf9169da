"""The Pareto front of error and run time, beyond noise."""

from collections.abc import Sequence

import numpy as np

from framework.evaluation.significance import RULE, Mean, least_significant

TIMES_APART = 0.05
"""Relative difference up to which two run times count as equal, because it may be noise."""
NOISE = f"front: {RULE}; run times within {100 * TIMES_APART:g} % count as equal"
"""The rule for a front, as text for a figure."""


def front(
    errors: Sequence[float] | Sequence[Mean], times: Sequence[float], times_apart: float = 0.0
) -> list[bool]:
    """Return which points are on the front of low error and short time.

    A point beats another if it is better in one of the two quantities beyond noise, and not worse beyond noise in the
    other. In the front no point beats another, and each point outside is beaten by a point inside. Only one set has
    both properties (the kernel). So of two points that are alike both are on the front. A point that only a beaten
    point beats is on it too. If unequal errors make points beat each other in a ring, the fastest of them is on it.
    Points that are not finite are not on it.

    Errors on the same samples are positively correlated, so they differ more surely than the test says.

    Args:
        errors: errors, lower is better; plain numbers are exact.
        times: run times.
        times_apart: share of the shorter time; a smaller difference is noise.

    Returns:
        One truth value per point. All are False if the standard error of a finite point is not known, because then it
        is not known which point beats which.
    """
    means = [one if isinstance(one, Mean) else Mean(float(one), 0.0) for one in errors]
    error, time = np.array([one.value for one in means], np.float64), np.array(times, np.float64)
    left = np.isfinite(error) & np.isfinite(time)
    apart = least_significant(means)
    np.fill_diagonal(apart, 0.0)  # a single point is on the front, whatever its error
    if np.isnan(apart[np.ix_(left, left)]).any():
        return [False] * len(means)
    with np.errstate(invalid="ignore"):  # infinite numbers are compared and then left out
        less, faster = (error[:, None] + apart < error), (time[:, None] * (1 + times_apart) < time)
    beats = (less & ~faster.T) | (faster & ~less.T)
    kept = np.zeros(len(error), bool)
    while left.any():
        free = left & ~beats[left].any(0)
        if not free.any():  # a ring
            free[np.flatnonzero(left)[np.argmin(time[left])]] = True
        kept |= free
        left &= ~free & ~beats[free].any(0)
    return kept.tolist()
