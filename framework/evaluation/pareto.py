"""Pareto front of error and run time, in which differences that may be noise do not count."""

from collections.abc import Sequence

import numpy as np

from framework.evaluation.significance import RULE, Mean, least_significant

TIME_NOISE = 0.05
"""Relative difference of two run times up to which they count as equal, because it may be noise."""
NOISE = f"front: {RULE}; run times within {100 * TIME_NOISE:g} % count as equal"
"""Rule of the front, as text for a figure."""


def front(
    errors: Sequence[float] | Sequence[Mean], times: Sequence[float], time_noise: float = 0.0
) -> list[bool]:
    """Return for each point whether it is on the Pareto front of low error and short run time.

    A point beats another if it is significantly better in one of the two quantities, and not significantly worse in the
    other. Errors differ significantly if their difference exceeds `least_significant`; run times differ significantly
    if their relative difference exceeds `time_noise`. The front is the set of points with two properties: none of its
    points beats another of them, and each point outside is beaten by one of them. So two equal points are both on the
    front, and so is a point that is beaten only by points outside the front. Errors with unequal uncertainty can make
    points beat each other in a ring, so that no such set exists; the fastest point of the ring is then on the front.
    Points that are not finite are not on the front.

    Errors on the same samples are positively correlated. The comparison ignores this, so it calls fewer differences
    significant than there are.

    Args:
        errors: errors, lower is better, as means with a standard error; plain numbers count as exact.
        times: run times, all in the same unit.
        time_noise: relative difference up to which two run times count as equal.

    Returns:
        One truth value per point. All are False if the standard error of a finite point is not known, because then
        points cannot be compared.
    """
    means = [value if isinstance(value, Mean) else Mean(float(value), 0.0) for value in errors]
    error, time = np.array([mean.value for mean in means], np.float64), np.array(times, np.float64)
    remaining = np.isfinite(error) & np.isfinite(time)
    margin = least_significant(means)
    np.fill_diagonal(margin, 0.0)  # a single point is on the front, whatever its error
    if np.isnan(margin[np.ix_(remaining, remaining)]).any():
        return [False] * len(means)
    with np.errstate(invalid="ignore"):  # points with infinite numbers are compared too, and left out below
        lower, faster = (error[:, None] + margin < error), (time[:, None] * (1 + time_noise) < time)
    beats = (lower & ~faster.T) | (faster & ~lower.T)
    on_front = np.zeros(len(error), bool)
    while remaining.any():
        unbeaten = remaining & ~beats[remaining].any(0)
        if not unbeaten.any():  # points that beat each other in a ring
            unbeaten[np.flatnonzero(remaining)[np.argmin(time[remaining])]] = True
        on_front |= unbeaten
        remaining &= ~unbeaten & ~beats[unbeaten].any(0)
    return on_front.tolist()
