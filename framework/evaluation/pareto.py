"""The Pareto front of error and run time, beyond noise."""

from collections.abc import Sequence

import numpy as np

from framework.evaluation.significance import RULE, Mean, least_significant

TIMES_APART = 0.05
"""Share by which two run times must differ: less may be noise."""
NOISE = f"front: {RULE}; run times within {100 * TIMES_APART:g} % count as equal"
"""The rule, for a figure."""


def front(
    errors: Sequence[float] | Sequence[Mean], times: Sequence[float], times_apart: float = 0.0
) -> list[bool]:
    """Return which points are on the front of low error and short time.

    One point beats another where it is better in one of the two beyond noise, and in the other not worse beyond noise.
    The front is the one set of which no point beats another and each point outside is beaten by one inside (the
    kernel): of two that are alike both are on it, and what only a beaten point beats is on it too. Where unlike errors
    make points beat each other in a ring, the fastest of them is on it. What is not finite is not.

    Errors on the same samples are positively correlated, and so differ more surely than the test says.

    Args:
        errors: lower is better; plain numbers are exact.
        times: run times.
        times_apart: share of the shorter time; a smaller difference is noise.

    Returns:
        One truth value a point; all False where the standard error of a finite point is not known, since then nobody
        knows what beats what.
    """
    means = [one if isinstance(one, Mean) else Mean(float(one), 0.0) for one in errors]
    error, time = np.array([one.value for one in means], np.float64), np.array(times, np.float64)
    left = np.isfinite(error) & np.isfinite(time)
    apart = least_significant(means)
    np.fill_diagonal(apart, 0.0)  # a point alone is on the front, whatever its error
    if np.isnan(apart[np.ix_(left, left)]).any():
        return [False] * len(means)
    with np.errstate(invalid="ignore"):  # infinite ones are compared and then left out
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
