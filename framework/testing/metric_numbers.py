"""Checks of a metric's numbers: standard errors, units and treatment of NaN; each records its largest error."""

import math
import re
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from framework.errors import UserError
from framework.target import Target
from framework.testing.finding import SEED, Worst

Numbers = Mapping[str, Tensor]
SEM = "_sem"
"""Suffix of the name of a standard error."""
NEAR = 0.15
"""Largest |log(stated standard error / jackknife's standard error)| for which the bootstrap is not used."""
RESAMPLES = 300
"""Number of resamples of the bootstrap."""
SCALE = 8.0
"""Ratio of two units of a target; a power of two, so that scaling is exact."""
SQUARES = re.compile(
    r"(^|[\W_])(mse|sse|squared?|squares|sq|var|variance|quadratic|energy|power|l2|2)([\W_]|$)"
)
"""Pattern of words in names and headings of numbers that have the square of the target's unit."""
ROOTS = re.compile(r"(^|[\W_])(root|rms[a-z]*)([\W_]|$)")
"""Pattern of words in names and headings of square roots."""


def check_standard_errors(evaluate: Callable[[Tensor], Numbers], count: int, worst: Worst) -> None:
    """Compare standard errors with those of the jackknife over test cases or, if these differ, of the bootstrap.

    The error is the absolute logarithm of the ratio of the two standard errors. For a mean, the jackknife gives the
    usual standard error (Efron & Tibshirani 1993, §11.1). For statistics that are not smooth, such as a median, only
    the bootstrap is valid (§11.6).

    Args:
        evaluate: Function from indices of test cases to the metric's numbers.
        count: Number of test cases.
        worst: Recorder of the worst case.
    """
    index = torch.arange(count)
    whole = evaluate(index)
    stated = {key: float(value) for key, value in whole.items() if _is_error(key, whole)}
    worst.count(False, "the metric has no standard errors")
    if not stated:
        return
    leave_one_out = [evaluate(index[index != removed]) for removed in range(count)]
    spread = {key: _deviation(leave_one_out, key) * (count - 1) / count**0.5 for key in stated}
    unsure = [key for key in stated if not _gap(stated[key], spread[key]) < NEAR]
    if unsure:
        random = np.random.default_rng(SEED)
        again = [evaluate(torch.from_numpy(random.integers(0, count, count))) for _ in range(RESAMPLES)]
        for key in unsure:
            boot = _deviation(again, key)
            spread[key] = min(spread[key], boot, key=lambda other, key=key: _gap(stated[key], other))
    for key, value in stated.items():
        worst.record(
            _gap(value, spread[key]),
            f"{key} is {value:.4g}, resampling {count} test cases gives {spread[key]:.4g}",
        )


def _is_error(key: str, whole: Numbers) -> bool:
    return key.endswith(SEM) and key.removesuffix(SEM) in whole


def _deviation(resampled: list[Numbers], key: str) -> float:
    """Return the standard deviation over resamples of the number whose standard error is named `key`."""
    return float(np.std([numbers[key.removesuffix(SEM)].item() for numbers in resampled]))


def _gap(first: float, second: float) -> float:
    if math.isnan(first) or math.isnan(second):
        return 0.0 if math.isnan(first) and math.isnan(second) else math.inf
    small = 1e-9
    return abs(math.log((abs(first) + small) / (abs(second) + small)))


def check_same(label: str, actual: Numbers, expected: Numbers, worst: Worst) -> None:
    """Check that numbers are equal; the error is relative to values above 1, and NaN equals NaN.

    Args:
        label: Description of the comparison, for the finding.
        actual: Numbers of the metric, by name.
        expected: Numbers that they must equal.
        worst: Recorder of the largest error.
    """
    worst.same(f"{label}: keys", sorted(actual), sorted(expected))
    for key in actual.keys() & expected.keys():
        value, reference = actual[key].double(), expected[key].double()
        gap = (value - reference).abs() / reference.abs().clamp(min=1)
        equal = (value.isnan() & reference.isnan()) | (value == reference)
        worst.record(
            gap.where(~equal, 0), f"{label}: {key} is {value.item():.9g}, expected {reference.item():.9g}"
        )


def check_degrees(columns: Mapping[str, str], wide: Sequence[Numbers], off: Numbers, worst: Worst) -> None:
    """Check that numbers named as degrees are not in radians, and that other numbers are not in degrees.

    Args:
        columns: Columns of the metric.
        wide: Numbers of the metric for several sets of predictions with large errors.
        off: Numbers of the metric for predictions with an error of 1 radian each.
        worst: Recorder of the worst case.
    """
    worst.count(False, "no number is in degrees or radians")
    for key, title in columns.items():
        if key not in off:
            continue
        largest = max(
            (abs(numbers[key].item()) for numbers in wide if numbers[key].isfinite()), default=math.inf
        )
        value = off[key].item()
        if _in_degrees(key, title):
            radians = largest <= 2 * math.pi or abs(value - 1) < 1e-4
            worst.count(
                radians,
                f"{key} is {value:.6g} for an error of 1 radian and at most {largest:.6g}: radians, expected degrees",
            )
        else:
            worst.count(
                abs(value - math.degrees(1)) < 1e-2,
                f"{key} is {value:.6g} for an error of 1 radian: degrees, which its name or heading must say",
            )


def _in_degrees(key: str, title: str) -> bool:
    return "deg" in key.split("_") or "degrees" in key.split("_") or "°" in title


def check_scaling(
    columns: Mapping[str, str],
    second_unit: Numbers,
    third_unit: Numbers,
    first_unit: Numbers,
    numbers: int,
    worst: Worst,
) -> None:
    """Check how numbers change with the target's unit; a standard error must scale as its number does.

    Targets in the second unit are SCALE times as large as in the first. A number that changes by a multiple of log
    SCALE is a logarithm of a density; the change must be in nats, not in bits.

    Args:
        columns: Columns of the metric.
        second_unit: Numbers of the metric in the second unit.
        third_unit: Numbers in a third unit, with targets SCALE times as large as in the second.
        first_unit: Numbers in the first unit.
        numbers: Number of real numbers of a target.
        worst: Recorder of the worst case.
    """
    worst.count(False, "no number depends on the unit")
    for key, value in first_unit.items():
        if key.endswith(SEM) or not value.isfinite() or not second_unit[key].isfinite() or value == 0:
            continue
        power = _power(second_unit[key], value)
        if power is not None and _power(third_unit[key], second_unit[key]) != power:
            continue  # a share of samples that has this ratio by chance
        title = f"{key} {columns.get(key, '')}".lower()
        worst.count(
            power == 2 and (not SQUARES.search(title) or bool(ROOTS.search(title))),
            f"{key} has the square of the target's unit, which neither its name nor its heading says",
        )
        if power is None:
            shift = (second_unit[key] - value).item() / math.log(SCALE)
            bits = abs(shift) > 1e-3 and _is_integer(shift * math.log(2)) and not _is_integer(shift)
            worst.count(
                bits and "bit" not in title,
                f"{key} changes by {shift:.6g} log {SCALE:g} for {numbers} numbers: bits, expected nats",
            )
        error = key + SEM
        if error in first_unit and first_unit[error].isfinite() and first_unit[error] != 0:
            other = _power(second_unit[error], first_unit[error])
            # the share of errors within a fixed distance, for example, neither scales nor shifts
            known = power is not None or _shifts(second_unit[key], value)
            worst.count(
                known and other != (power or 0),
                f"{error} scales with power {other} of the target's unit, but {key} with power {power or 0}",
            )


def _power(second: Tensor, first: Tensor) -> int | None:
    ratio = (second / first).item()
    if ratio <= 0:
        return None
    power = math.log(ratio) / math.log(SCALE)
    return round(power) if abs(power - round(power)) < 1e-6 else None


def _shifts(second: Tensor, first: Tensor) -> bool:
    shift = (second - first).item() / math.log(SCALE)
    return _is_integer(shift) or _is_integer(shift * math.log(2))


def _is_integer(number: float) -> bool:
    return abs(number - round(number)) < 1e-6 * max(1.0, abs(number))


def check_nats(columns: Mapping[str, str], target: Target, flat: Numbers, worst: Worst) -> None:
    """Check that no number is in bits, for uniform densities, whose log-density and entropy are known.

    Args:
        columns: Columns of the metric.
        target: Target of the predictions.
        flat: Numbers of the metric for uniform predictions of the target.
        worst: Recorder of the worst case.
    """
    uniform = math.log2(len(target.names)) if target.kind == "class" else math.log2(2 * math.pi)
    if target.kind == "angle":
        uniform *= len(target.names)
    worst.count(False, "no number is in bits")
    for key, value in flat.items():
        title = f"{key} {columns.get(key, '')}".lower()
        # for two or four classes the number of bits is an integer, which other numbers may also equal
        bits = not _is_integer(uniform) and abs(abs(value.item()) - uniform) < 1e-6
        worst.count(
            bits and "bit" not in title,
            f"{key} is {value.item():.6g} for uniform densities: bits, expected nats",
        )


def check_nan_visible(
    evaluate: Callable[[], Numbers],
    whole: Numbers,
    moved: Numbers,
    without: Numbers,
    columns: Mapping[str, str],
    better: Mapping[str, str],
    worst: Worst,
) -> None:
    """Check that a metric does not leave out predictions that are NaN.

    The metric must refuse these predictions, or its numbers must be NaN or worse than without NaN.

    Args:
        evaluate: Function that returns the numbers if the predictions of some samples are NaN.
        whole: Numbers with the original predictions.
        moved: Numbers with other, finite predictions for these samples.
        without: Numbers without these samples.
        columns: Columns of the metric.
        better: Column → "higher" or "lower", whichever is better.
        worst: Recorder of the worst case.
    """
    try:
        with_nan = evaluate()
    except (UserError, ValueError, RuntimeError) as error:
        worst.count(False, f"NaN is refused: {error}")
        return
    worst.count(False, "no number depends on these predictions")
    for key in columns:
        if key not in with_nan or not with_nan[key].isfinite():
            continue
        # NaN cannot affect a number that does not depend on these predictions
        if (whole[key] - moved[key]).abs() < 1e-12 or whole[key] == without[key]:
            continue
        value, left = with_nan[key].item(), without[key].item()
        flattered = abs(value - left) < 1e-12
        if better.get(key) == "higher":
            flattered &= left != 0  # a share of 0 stays 0 with more wrong predictions
        if key in better:
            flattered |= value > left if better[key] == "higher" else value < left
        worst.count(
            flattered,
            f"{key} is {value:.6g} with predictions of NaN, and {left:.6g} without them; expected NaN, an error, or a "
            "worse number",
        )
