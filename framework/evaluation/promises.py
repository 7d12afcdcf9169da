"""Sets and intervals in which a model says that the target lies, as columns of a table of predictions."""

import json
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from framework.distributions.intervals import Interval
from framework.distributions.protocol import ValueSet, value_set
from framework.errors import ConfigError
from framework.prediction import Prediction
from framework.target import Target

Ends = Sequence[tuple[float, float]]
"""Pairs (low, high) of the ends of intervals."""


@torch.no_grad()
def promised(target: Target, prediction: Prediction) -> dict[str, list[Any]]:
    """Return the columns of the set that comes with each density (`protocol.value_set`), in the user's names and units.

    A density without a set has no columns.

    - For classes: `set`, a JSON list of their names, and `set_size`, their number.
    - For one real: `x_set`, a JSON list of [low, high] pairs, with its first and last end, `x_low` and `x_high`, and
    `set_size`, the total length of the pairs. Ends may be infinite; for an empty set they are NaN.
    - For one angle: the same in degrees, counter-clockwise from `x_low_deg` in [-180, 180) to `x_high_deg`, which may
    lie beyond 180. These are the ends of the shortest arc that holds the set.
    - For several numbers: only `set_size`, the volume; in radians for angles.
    """
    sets = value_set(prediction.density)
    if sets is None:
        return {}
    degrees = target.kind == "angle" and len(target.names) == 1
    unit = 180 / math.pi if degrees else 1.0
    size = {"set_size_deg" if degrees else "set_size": (unit * prediction.set_size(sets)).tolist()}
    parts = sets.parts()
    if parts is None:
        return size
    if target.kind == "class":
        named = [[target.names[int(label)] for label in row] for row in parts]  # type: ignore[call-overload]
        return {"set": [json.dumps(row, ensure_ascii=False) for row in named], **size}
    name, end = target.names[0], "_deg" if degrees else ""
    listed: list[Ends] = [[(unit * low, unit * high) for low, high in row] for row in parts]  # type: ignore[misc]
    hulls = [_arc_around(row) if degrees else _around(row) for row in listed]
    return {
        f"{name}_low{end}": [low for low, _ in hulls],
        f"{name}_high{end}": [high for _, high in hulls],
        f"{name}_set{end}": [json.dumps([list(ends) for ends in row]) for row in listed],
        **size,
    }


def _around(ends: Ends) -> tuple[float, float]:
    """Return the first and the last end of ascending intervals; NaN if there is no interval."""
    return (ends[0][0], ends[-1][1]) if ends else (math.nan, math.nan)


def _arc_around(arcs: Ends) -> tuple[float, float]:
    """Return the ends of the shortest arc that holds ascending arcs, degrees: the complement of their widest gap."""
    if not arcs:
        return math.nan, math.nan
    starts = [low for low, _ in arcs]
    gaps = [after - high for (_, high), after in zip(arcs, [*starts[1:], starts[0] + 360], strict=True)]
    last = max(range(len(gaps)), key=gaps.__getitem__)
    first = (last + 1) % len(arcs)
    high = arcs[last][1]
    return starts[first], high if first == 0 else high + 360


def require_interval(target: Target, mass: float, by: str) -> None:
    """Refuse intervals of a target that has none.

    Args:
        target: the predicted quantity.
        mass: probability of the requested intervals.
        by: setting that requests them.

    Raises:
        ConfigError: the target is not of reals or angles.
    """
    if target.kind not in ("real", "angle"):
        has = {"class": "the probability of each class is a column", "image": "metrics give those of images"}
        raise ConfigError(
            f"{by}={mass:g} gives the ends of intervals of reals and angles, but this model predicts "
            f"{target.kind} targets ({target.listed_names}): {has[target.kind]}. Leave {by} out."
        )


def require_promised(sets: ValueSet, mass: float, by: str) -> None:
    """Refuse an interval beside a set of another probability, because the interval would be taken for that set.

    Raises:
        ConfigError: the probabilities differ, or the set has no ends; the message says the probability of the set.
    """
    if (
        sets.stated_probability is not None
        and math.isclose(sets.stated_probability, mass, abs_tol=1e-9)
        and sets.parts() is not None
    ):
        return
    if sets.stated_probability is None or sets.parts() is None:
        raise ConfigError(
            f"{by}={mass:g} asks for the ends of an interval, but this model predicts a set in which the target lies, "
            f"and it has no such ends. Leave {by} out: the set's columns are printed without it."
        )
    raise ConfigError(
        f"{by}={mass:g}, but the sets of this model promise to hold {sets.stated_probability:g} of the targets, "
        f"and no other interval of it promises anything. Give {by}={sets.stated_probability:g}, or leave it out: the "
        "set is printed anyway."
    )


def ends(target: Target, interval: Interval) -> dict[str, Tensor]:
    """Return columns of the ends of intervals and of their standard errors, (batch,) each.

    Angles are in degrees. `low` is in [-180, 180), and the interval runs counter-clockwise from `low` to `high`.
    """
    unit, end = (180 / math.pi, "_deg") if target.kind == "angle" else (1.0, "")
    return {
        f"{name}_{field}{end}": unit * values[:, index]
        for field, values in interval._asdict().items()
        for index, name in enumerate(target.names)
    }
