"""Significance of differences between means: which differences are larger than chance explains."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

SHARE = 0.04
"""Probability that a difference between two equal methods is called significant.

It is one percentage point below the stated 5 %, because Welch's test is only approximate for few runs with unequal
standard deviations.
"""
RULE = "every difference significant at 95 %, Welch's t-test"
"""Rule by which differences are significant, as text for the caption of a table or figure."""

ROUNDING = 16 * float(np.finfo(np.float32).eps)
"""Largest difference of two measured numbers that rounding explains, relative to the larger of them.

Results are means of numbers that a network computes in float32. Each of these comes from sums of many terms, whose
order depends on the batch size, the number of threads and the device, so that its last bits are not reproducible. Two
methods that are equal in exact arithmetic therefore differ by a few eps, and by nearly the same amount in every run,
which no test over runs can tell from a real difference.
"""

_SOURCES = ("runs", "samples")


@dataclass(frozen=True)
class Mean:
    """A mean and its standard error.

    Attributes:
        value: the mean.
        standard_error: standard error of the mean; 0 if the mean is exact, NaN if the standard error is not known.
        degrees: degrees of freedom of the standard error; infinite if it comes from many test samples.
        source: "runs" or "samples": what the standard error was computed over; "" if the mean is exact or the standard
            error is not known.
    """

    value: float
    standard_error: float = math.nan
    degrees: float = math.inf
    source: Literal["runs", "samples", ""] = ""


def mean(numbers: Mapping[str, object], key: str, runs: object) -> Mean:
    """Return the mean `key` of a result with its standard error.

    The standard error is "<key>_sem". If `numbers` lacks it, it is computed from "<key>_std", the standard deviation
    over `runs` runs. A whole number (such as a count of parameters) with neither of these keys is exact.

    Args:
        numbers: numbers of a result by key, as in results.json. If "repeats" is among them, "<key>_sem" was computed
            over this number of runs, otherwise over the test samples of one run, whose number is "test_samples".
        key: key of the mean.
        runs: number of runs over which the mean was computed; anything but a whole number means that it is not known.
    """
    value = numbers.get(key)
    exact = isinstance(value, int | np.integer) and not isinstance(value, bool)
    number = float(value) if isinstance(value, int | float | np.integer | np.floating) else math.nan
    sample_error, spread = numbers.get(f"{key}_sem"), numbers.get(f"{key}_std")
    if isinstance(sample_error, int | float) and math.isfinite(sample_error):
        repeats, samples = numbers.get("repeats"), numbers.get("test_samples")
        if isinstance(repeats, int):
            return Mean(number, float(sample_error), float(repeats - 1), "runs")
        return Mean(
            number,
            float(sample_error),
            float(samples - 1) if isinstance(samples, int) else math.inf,
            "samples",
        )
    if isinstance(spread, int | float) and math.isfinite(spread) and isinstance(runs, int) and runs > 1:
        return Mean(number, spread / math.sqrt(runs), float(runs - 1), "runs")
    return Mean(number, 0.0) if exact else Mean(number)


def least_significant(means: Sequence[Mean]) -> Float[np.ndarray, "means means"]:
    """Return for each pair of means the smallest significant difference, (means, means).

    The smallest significant difference is the quantile of Student's t times the standard error of the difference, with
    the degrees of freedom of B. L. Welch (1947), "The generalization of 'Student's' problem when several different
    population variances are involved", Biometrika 34, 28-35. It is NaN if a standard error is not known, or if one
    standard error was computed over runs and the other over the samples of a single run: the latter does not include
    the differences between runs. Between measured means it is at least what rounding explains (`ROUNDING`); exact means
    have no rounding.
    """
    from scipy.special import stdtrit

    errors = np.array([mean.standard_error for mean in means], np.float64)
    # A single test sample or run leaves no degree of freedom, and so no standard error.
    degrees = np.array([mean.degrees if mean.degrees > 0 else math.nan for mean in means], np.float64)
    sources = np.array([_SOURCES.index(mean.source) if mean.source else -1 for mean in means])
    variances = errors**2
    total = variances[:, None] + variances
    # Squares of the variance may overflow or underflow; squares of its shares do not.
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(total > 0, variances[:, None] / total, 0.0)
        pooled = 1.0 / (share**2 / degrees[:, None] + (share**2 / degrees[:, None]).T)
    pooled = np.where(total > 0, pooled, math.inf)
    # stdtrit takes no infinite degrees of freedom; beyond 1e9 Student's t is normal to rounding.
    quantile = stdtrit(np.minimum(pooled, 1e9), 1 - SHARE / 2)
    mixed = (sources[:, None] != sources) & (sources[:, None] >= 0) & (sources >= 0)
    sizes = np.array([abs(mean.value) if math.isfinite(mean.value) else 0.0 for mean in means], np.float64)
    measured = (sources[:, None] >= 0) | (sources >= 0)
    rounding = np.where(measured, ROUNDING * np.maximum(sizes[:, None], sizes), 0.0)
    return np.where(mixed, math.nan, np.maximum(quantile * np.hypot(errors[:, None], errors), rounding))


def significantly_best(
    means: Sequence[Mean], better: Literal["higher", "lower"]
) -> Bool[np.ndarray, "means"]:
    """Return for each mean whether it is better than every other mean by more than chance explains; at most one is.

    The test needs no correction for the number of means, because the best mean must differ from every other mean,
    including the second best, which is the nearest (an intersection-union test: R. L. Berger (1982), Technometrics 24,
    295-300).
    """
    values = np.array([mean.value for mean in means], np.float64) * (1 if better == "higher" else -1)
    with np.errstate(invalid="ignore"):
        ahead = values[:, None] - values > least_significant(means)
    np.fill_diagonal(ahead, True)
    return np.logical_and(ahead.all(1), len(means) > 1)


@dataclass(frozen=True)
class Difference:
    """Mean difference of paired numbers, such as the results of two methods with the same seeds.

    Attributes:
        value: the mean difference.
        standard_error: standard error of the mean difference; NaN for fewer than two pairs.
        probability: two-sided p-value of Student's t-test for pairs, the probability of so large a difference if the
            methods are equal; NaN for fewer than two pairs, 1 if rounding explains the difference.
        pairs: number of pairs.
        rounding: largest mean difference that rounding explains.
    """

    value: float
    standard_error: float
    probability: float
    pairs: int
    rounding: float


def paired_difference(first: Sequence[float], second: Sequence[float]) -> Difference:
    """Return the mean of first - second over pairs, with its standard error and the p-value of a t-test.

    If all differences are equal, the standard error is 0. The p-value is then 0, unless rounding explains the
    difference: if the mean difference is at most `ROUNDING` times the mean size of the numbers, the p-value is 1. Of a
    pair, the larger size counts.
    """
    from scipy.special import stdtr

    numbers = np.asarray([first, second], np.float64)
    count = numbers.shape[1]
    if not count:
        return Difference(math.nan, math.nan, math.nan, 0, math.nan)
    with np.errstate(invalid="ignore"):  # infinite numbers have no p-value
        differences = numbers[0] - numbers[1]
        value, rounding = float(differences.mean()), ROUNDING * float(np.abs(numbers).max(0).mean())
        error = float(differences.std(ddof=1)) / math.sqrt(count) if count > 1 else math.nan
    if math.isnan(error):
        probability = math.nan
    elif abs(value) <= rounding:
        probability = 1.0
    else:
        probability = float(2 * stdtr(count - 1, -abs(value) / error)) if error > 0 else 0.0
    return Difference(value, error, probability, count, rounding)


def holm(probabilities: Sequence[float], others: int = 0) -> list[float]:
    """Return the p-values of several tests, corrected for the number of tests; NaN stays NaN and is not counted.

    A test is significant at 5 % if its corrected p-value is at most 0.05. The probability that at least one test of two
    equal methods is significant is then at most 5 % (S. Holm (1979), "A simple sequentially rejective multiple test
    procedure", Scandinavian Journal of Statistics 6, 65-70).

    Args:
        probabilities: p-values of the tests.
        others: number of further tests whose p-values are not given, such as those that were not chosen after a look at
            the results. The correction is the one for the least favourable p-values of these tests.
    """
    order = sorted(
        (index for index, value in enumerate(probabilities) if not math.isnan(value)),
        key=probabilities.__getitem__,
    )
    corrected = [math.nan] * len(probabilities)
    largest = 0.0
    for rank, index in enumerate(order):
        largest = max(largest, min(1.0, (len(order) + others - rank) * probabilities[index]))
        corrected[index] = largest
    return corrected
