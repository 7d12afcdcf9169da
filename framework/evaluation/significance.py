"""Significance of differences between means: which of them are larger than chance explains."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

SHARE = 0.04
"""Share of tables of two equal methods in which a difference is called significant.

It is one percentage point below the stated 5 %, because Welch's test is approximate if runs are few and their standard
deviations differ.
"""
RULE = "every difference significant at 95 %, Welch's t-test"
"""The rule, as text for a caption."""

_SOURCES = ("runs", "samples")


@dataclass(frozen=True)
class Mean:
    """A mean, and what is known of its error.

    Attributes:
        value: the mean.
        standard_error: standard error of the mean; 0 if the mean is exact, NaN if the error is not known.
        degrees: degrees of freedom of the standard error; infinite if it comes from many test samples.
        source: what the standard error was taken over, "runs" or "samples"; "" if the mean is exact or the error not
            known.
    """

    value: float
    standard_error: float = math.nan
    degrees: float = math.inf
    source: Literal["runs", "samples", ""] = ""


def mean(numbers: Mapping[str, object], key: str, runs: object) -> Mean:
    """Return the mean `key` of a result with its error.

    The error is "<key>_sem", the standard error over the test samples of one run. If there is none, it is computed from
    "<key>_std", the standard deviation over `runs` runs. A whole number (such as a count of parameters) without either
    is exact.

    Args:
        numbers: a result, as for `framework.reports.table`. "repeats" is the number of repeats that all its errors are
            over, if there were any; otherwise "test_samples" is the number of test samples that a "<key>_sem" is over.
        key: key of the mean.
        runs: number of runs that the mean is over; anything but a whole number means that it is not known.
    """
    value = numbers.get(key)
    exact = isinstance(value, int | np.integer) and not isinstance(value, bool)
    number = float(value) if isinstance(value, int | float | np.integer | np.floating) else math.nan
    own, spread = numbers.get(f"{key}_sem"), numbers.get(f"{key}_std")
    if isinstance(own, int | float) and math.isfinite(own):
        repeats, samples = numbers.get("repeats"), numbers.get("test_samples")
        if isinstance(repeats, int):
            return Mean(number, float(own), float(repeats - 1), "runs")
        return Mean(
            number, float(own), float(samples - 1) if isinstance(samples, int) else math.inf, "samples"
        )
    if isinstance(spread, int | float) and math.isfinite(spread) and isinstance(runs, int) and runs > 1:
        return Mean(number, spread / math.sqrt(runs), float(runs - 1), "runs")
    return Mean(number, 0.0) if exact else Mean(number)


def least_significant(means: Sequence[Mean]) -> Float[np.ndarray, "means means"]:
    """Return for each pair of means the smallest significant difference, (means, means).

    It is the quantile of Student's t times the standard error of the difference. The degrees of freedom are those of B.
    L. Welch (1947), "The generalization of 'Student's' problem when several different population variances are
    involved", Biometrika 34, 28-35. It is NaN if an error is not known, and if one error is over runs and the other
    over the samples of a single run, because the latter does not contain the differences between runs.
    """
    from scipy.special import stdtrit

    errors = np.array([one.standard_error for one in means], np.float64)
    # A single test sample or run leaves no degree of freedom, and so no standard error.
    degrees = np.array([one.degrees if one.degrees > 0 else math.nan for one in means], np.float64)
    sources = np.array([_SOURCES.index(one.source) if one.source else -1 for one in means])
    variances = errors**2
    total = variances[:, None] + variances
    # Shares of the variance neither overflow nor underflow, but squares of the variance do.
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(total > 0, variances[:, None] / total, 0.0)
        pooled = 1.0 / (share**2 / degrees[:, None] + (share**2 / degrees[:, None]).T)
    pooled = np.where(total > 0, pooled, math.inf)
    # stdtrit takes no infinite degrees of freedom; beyond 1e9 Student's t is normal to rounding.
    quantile = stdtrit(np.minimum(pooled, 1e9), 1 - SHARE / 2)
    mixed = (sources[:, None] != sources) & (sources[:, None] >= 0) & (sources >= 0)
    return np.where(mixed, math.nan, quantile * np.hypot(errors[:, None], errors))


def significantly_best(
    means: Sequence[Mean], better: Literal["higher", "lower"]
) -> Bool[np.ndarray, "means"]:
    """Return which mean is better than every other mean by more than chance explains: one of them, or none.

    No correction for the number of means is needed. The best must differ from every other one, and so from the second
    best, which is the nearest of them (an intersection-union test: R. L. Berger (1982), Technometrics 24, 295-300).
    """
    values = np.array([one.value for one in means], np.float64) * (1 if better == "higher" else -1)
    with np.errstate(invalid="ignore"):
        ahead = values[:, None] - values > least_significant(means)
    np.fill_diagonal(ahead, True)
    return np.logical_and(ahead.all(1), len(means) > 1)
