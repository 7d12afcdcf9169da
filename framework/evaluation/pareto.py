"""The Pareto front of error and run time, beyond noise."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

ERRORS_APART, TIMES_APART = 2.0, 0.05
"""Two errors differ by more than so many joint standard errors, two run times by more than this share: else it may be
noise. Errors on the same samples are positively correlated, and so differ more surely than the joint error says."""
NOISE = (
    f"noise: errors within {ERRORS_APART:g} joint standard errors, run times within {100 * TIMES_APART:g} %"
)
"""The rule, for a picture."""


def front(
    errors: Sequence[float],
    times: Sequence[float],
    standard_errors: Sequence[float] | None = None,
    times_apart: float = 0.0,
) -> list[bool]:
    """Which points are on the front; without standard errors those that no other has less error or time than, and no
    more of the other.

    One point beats another where it is better in one beyond noise, and in the other not worse beyond noise. The front
    is the one set of which no point beats another and each point outside is beaten by one inside (the kernel): of two
    that are alike both are on it, and what only a beaten point beats is on it too. Where unlike errors make points beat
    each other in a ring, the fastest of them is on it. What is not finite is not.

    Args:
        standard_errors: of the errors; NaN, not known, is taken for 0.
        times_apart: a share of the shorter time; less is noise.
    """
    error, time = np.array(errors, np.float64), np.array(times, np.float64)
    noise = np.nan_to_num(np.zeros_like(error) if standard_errors is None else np.array(standard_errors))
    apart = ERRORS_APART * np.hypot(noise[:, None], noise)
    left = np.isfinite(error) & np.isfinite(time)
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


def standard_error(numbers: Mapping[str, object], key: str, runs: object) -> float:
    """Of the mean `key`: its "<key>_sem", or of "<key>_std" over so many runs; NaN where neither is known."""
    own, spread = numbers.get(f"{key}_sem"), numbers.get(f"{key}_std")
    if isinstance(own, int | float) and math.isfinite(own):
        return float(own)
    if isinstance(spread, int | float) and isinstance(runs, int) and runs > 0:
        return spread / math.sqrt(runs)
    return math.nan
