"""Checks of a metric's numbers: their standard errors, units and treatment of NaN; each reports its worst case."""

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
NEAR = 0.15
"""Relative difference between a standard error and the jackknife's above which the bootstrap decides."""
RESAMPLES = 300
SCALE = 8.0
"""Factor between two units of a target; a power of two, so that scaling is exact."""
SQUARES = re.compile(
    r"(^|[\W_])(mse|sse|squared?|squares|sq|var|variance|quadratic|energy|power|l2|2)([\W_]|$)"
)

ROOTS = re.compile(r"(^|[\W_])(root|rms[a-z]*)([\W_]|$)")


def standard_errors(judge: Callable[[Tensor], Numbers], count: int, worst: Worst) -> None:
    """Check standard errors against the jackknife over test cases, or else against their bootstrap.

    The error is the absolute logarithm of the ratio. The jackknife of a mean is the standard error itself (Efron &
    Tibshirani 1993, §11.1). For statistics that are not smooth, such as a median, only the bootstrap is valid (§11.6).

    Args:
        judge: Function from indices of test cases to the metric's numbers.
        count: Number of test cases.
        worst: Recorder of the worst case.
    """
    index = torch.arange(count)
    whole = judge(index)
    said = {key: float(value) for key, value in whole.items() if _is_error(key, whole)}
    worst.count(False, "no number has a standard error")
    if not said:
        return
    left = [judge(index[index != one]) for one in range(count)]
    spread = {key: _deviation(left, key) * (count - 1) / count**0.5 for key in said}
    unsure = [key for key in said if not _gap(said[key], spread[key]) < NEAR]
    if unsure:
        random = np.random.default_rng(SEED)
        again = [judge(torch.from_numpy(random.integers(0, count, count))) for _ in range(RESAMPLES)]
        for key in unsure:
            boot = _deviation(again, key)
            spread[key] = min(spread[key], boot, key=lambda other, key=key: _gap(said[key], other))
    for key, value in said.items():
        worst.see(
            _gap(value, spread[key]), f"{key} {value:.4g}, by resampling {count} test cases {spread[key]:.4g}"
        )


def _is_error(key: str, whole: Numbers) -> bool:
    return key.endswith(SEM) and key.removesuffix(SEM) in whole


def _deviation(found: list[Numbers], key: str) -> float:
    """Return the standard deviation of the number to which the standard error `key` belongs."""
    return float(np.std([numbers[key.removesuffix(SEM)].item() for numbers in found]))


def _gap(one: float, other: float) -> float:
    if math.isnan(one) or math.isnan(other):
        return 0.0 if math.isnan(one) and math.isnan(other) else math.inf
    small = 1e-9
    return abs(math.log((abs(one) + small) / (abs(other) + small)))


def same(what: str, found: Numbers, wanted: Numbers, worst: Worst) -> None:
    """Check that numbers agree; the error is relative to values above 1, and NaN equals NaN."""
    worst.same(f"{what}: keys", sorted(found), sorted(wanted))
    for key in found.keys() & wanted.keys():
        one, other = found[key].double(), wanted[key].double()
        gap = (one - other).abs() / other.abs().clamp(min=1)
        equal = (one.isnan() & other.isnan()) | (one == other)
        worst.see(gap.where(~equal, 0), f"{what}: {key} {one.item():.9g}, wanted {other.item():.9g}")


def degrees(columns: Mapping[str, str], wide: Sequence[Numbers], off: Numbers, worst: Worst) -> None:
    """Check that numbers named as degrees are not radians, and that other numbers of angles are not degrees.

    Args:
        columns: Columns of the metric.
        wide: Numbers of the metric for predictions that are far off in various ways.
        off: Numbers of the metric for predictions that are each 1 radian off.
        worst: Recorder of the worst case.
    """
    worst.count(False, "no number says its unit")
    for key, title in columns.items():
        if key not in off:
            continue
        largest = max((abs(found[key].item()) for found in wide if found[key].isfinite()), default=math.inf)
        value = off[key].item()
        if _in_degrees(key, title):
            radians = largest <= 2 * math.pi or abs(value - 1) < 1e-4
            worst.count(
                radians, f"{key} is {value:.6g} of a deviation of 1 radian and never above {largest:.6g}"
            )
        else:
            worst.count(
                abs(value - math.degrees(1)) < 1e-2,
                f"{key} is {value:.6g} of a deviation of 1 radian: its name must say degrees",
            )


def _in_degrees(key: str, title: str) -> bool:
    return "deg" in key.split("_") or "degrees" in key.split("_") or "°" in title


def scaled(
    columns: Mapping[str, str], found: Numbers, again: Numbers, wanted: Numbers, numbers: int, worst: Worst
) -> None:
    """Check how numbers change with the target's unit: a number scales or does not, its standard error likewise.

    Targets in the other unit are SCALE times as large. Logarithms of densities must shift by nats.

    Args:
        columns: Columns of the metric.
        found: Numbers of the metric in the other unit.
        again: Numbers in a third unit, SCALE times as large as the second.
        wanted: Numbers in the first unit.
        numbers: Number of reals of a target.
        worst: Recorder of the worst case.
    """
    worst.count(False, "no number scales")
    for key, value in wanted.items():
        if key.endswith(SEM) or not value.isfinite() or not found[key].isfinite() or value == 0:
            continue
        power = _power(found[key], value)
        if power is not None and _power(again[key], found[key]) != power:
            continue  # a share that has this ratio by chance
        title = f"{key} {columns.get(key, '')}".lower()
        worst.count(
            power == 2 and (not SQUARES.search(title) or bool(ROOTS.search(title))),
            f"{key} scales as the square of the target's unit, which neither its name nor its heading says",
        )
        if power is None:
            shift = (found[key] - value).item() / math.log(SCALE)
            bits = abs(shift) > 1e-3 and _whole(shift * math.log(2)) and not _whole(shift)
            worst.count(
                bits and "bit" not in title,
                f"{key} shifts by {shift:.6g} log {SCALE:g} of {numbers} numbers: bits, wanted nats",
            )
        error = key + SEM
        if error in wanted and wanted[error].isfinite() and wanted[error] != 0:
            other = _power(found[error], wanted[error])
            # a share within a fixed distance, for example, neither scales nor shifts
            known = power is not None or _shifts(found[key], value)
            worst.count(
                known and other != (power or 0),
                f"{error} scales by the power {other} of the target's unit, {key} by {power or 0}",
            )


def _power(found: Tensor, wanted: Tensor) -> int | None:
    ratio = (found / wanted).item()
    if ratio <= 0:
        return None
    power = math.log(ratio) / math.log(SCALE)
    return round(power) if abs(power - round(power)) < 1e-6 else None


def _shifts(found: Tensor, wanted: Tensor) -> bool:
    shift = (found - wanted).item() / math.log(SCALE)
    return _whole(shift) or _whole(shift * math.log(2))


def _whole(number: float) -> bool:
    return abs(number - round(number)) < 1e-6 * max(1.0, abs(number))


def nats(columns: Mapping[str, str], target: Target, flat: Numbers, worst: Worst) -> None:
    """Check that no number is in bits, at uniform densities, whose log-densities and entropies are all known.

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
        # for two or four classes, bits are whole numbers, which a share may also be
        bits = not _whole(uniform) and abs(abs(value.item()) - uniform) < 1e-6
        worst.count(
            bits and "bit" not in title,
            f"{key} of uniform densities is {value.item():.6g}: bits, wanted nats",
        )


def not_hidden(
    judge: Callable[[], Numbers],
    whole: Numbers,
    moved: Numbers,
    without: Numbers,
    columns: Mapping[str, str],
    better: Mapping[str, str],
    worst: Worst,
) -> None:
    """Check that predictions of NaN are refused, make the numbers NaN, or make them worse, but are not left out.

    Args:
        judge: Function that returns the numbers with such predictions.
        whole: Numbers without such predictions.
        moved: Numbers where these predictions have other values.
        without: Numbers without these samples.
        columns: Columns of the metric.
        better: Better direction of columns.
        worst: Recorder of the worst case.
    """
    try:
        found = judge()
    except (UserError, ValueError, RuntimeError) as error:
        worst.count(False, f"refused: {error}")
        return
    worst.count(False, "no number depends on the prediction")
    for key in columns:
        if key not in found or not found[key].isfinite():
            continue
        # NaN cannot affect a number that does not depend on these predictions
        if (whole[key] - moved[key]).abs() < 1e-12 or whole[key] == without[key]:
            continue
        value, left = found[key].item(), without[key].item()
        flattered = abs(value - left) < 1e-12
        if better.get(key) == "higher":
            flattered &= left != 0  # a share of 0 stays 0 with one more wrong prediction
        if key in better:
            flattered |= value > left if better[key] == "higher" else value < left
        worst.count(
            flattered,
            f"{key} is {value:.6g} though some predictions are NaN, {left:.6g} without them; wanted NaN or an error",
        )
