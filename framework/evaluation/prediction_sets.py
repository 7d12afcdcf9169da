"""Prediction sets and intervals of a model, as columns of a table of predictions."""

import json
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from framework.distributions.intervals import Interval
from framework.distributions.numpy_densities import arc_hull, hull
from framework.distributions.protocol import ValueSet, value_set
from framework.errors import ConfigError
from framework.prediction import Prediction
from framework.target import Target

Ends = Sequence[tuple[float, float]]
"""Intervals as pairs (low, high)."""


@torch.no_grad()
def set_columns(target: Target, prediction: Prediction) -> dict[str, list[Any]]:
    """Return the columns of the prediction sets (`protocol.value_set`), in the user's names and units.

    There are no columns if the densities have no prediction sets. In the names of columns below, `x` stands for the
    name of the target.

    - For classes: `set`, a JSON list of class names, and `set_size`, their number.
    - For one real number: `x_set`, a JSON list of [low, high] pairs; `x_low` and `x_high`, the lowest and highest end;
    and `set_size`, the total length. Ends may be infinite; for an empty set they are NaN.
    - For one angle: the same columns in degrees, with names that end in `_deg`. `x_low_deg`, in [-180, 180), and
    `x_high_deg`, which may exceed 180, are the ends of the shortest arc that contains the set, counter-clockwise.
    - For several numbers: only `set_size`, the volume; in radians for angles.
    """
    sets = value_set(prediction.density)
    if sets is None:
        return {}
    degrees = target.kind == "angle" and len(target.names) == 1
    scale = 180 / math.pi if degrees else 1.0
    size = {"set_size_deg" if degrees else "set_size": (scale * prediction.set_size(sets)).tolist()}
    parts = sets.parts()
    if parts is None:
        return size
    if target.kind == "class":
        named = [[target.names[int(label)] for label in row] for row in parts]  # type: ignore[call-overload]
        return {"set": [json.dumps(row, ensure_ascii=False) for row in named], **size}
    name, suffix = target.names[0], "_deg" if degrees else ""
    listed: list[Ends] = [[(scale * low, scale * high) for low, high in row] for row in parts]  # type: ignore[misc]
    hulls = [arc_hull(row) if degrees else hull(row) for row in listed]
    return {
        f"{name}_low{suffix}": [low for low, _ in hulls],
        f"{name}_high{suffix}": [high for _, high in hulls],
        f"{name}_set{suffix}": [json.dumps([list(pair) for pair in row]) for row in listed],
        **size,
    }


def require_interval(target: Target, mass: float, by: str) -> None:
    """Raise an error if intervals are requested for a target that has none, such as a class.

    Args:
        target: the predicted quantity.
        mass: probability of the requested intervals.
        by: setting that requests them.

    Raises:
        ConfigError: the target is neither real numbers nor angles.
    """
    if target.kind not in ("real", "angle"):
        alternative = {
            "class": "the table has a column with the probability of each class",
            "image": "use the metrics of images instead",
        }
        raise ConfigError(
            f"{by}={mass:g} requests intervals of real numbers or angles, but this model predicts targets of kind "
            f"{target.kind} ({target.listed_names}). Leave {by} out; {alternative[target.kind]}."
        )


def require_matching_set(sets: ValueSet, mass: float, by: str) -> None:
    """Raise an error if the model predicts sets from which intervals of the requested probability cannot be read.

    Args:
        sets: prediction sets of the model.
        mass: probability of the requested intervals.
        by: setting that requests them.

    Raises:
        ConfigError: the sets have no stated probability, another one than `mass`, or no ends that could be printed.
    """
    if (
        sets.stated_probability is not None
        and math.isclose(sets.stated_probability, mass, abs_tol=1e-9)
        and sets.parts() is not None
    ):
        return
    if sets.stated_probability is None or sets.parts() is None:
        raise ConfigError(
            f"{by}={mass:g} requests the ends of an interval, but this model predicts sets, which do not have such "
            f"ends. Leave {by} out; the columns of the sets are always printed."
        )
    raise ConfigError(
        f"{by}={mass:g}, but this model predicts sets that contain the target with probability "
        f"{sets.stated_probability:g}; intervals of another probability have no such guarantee. Set "
        f"{by}={sets.stated_probability:g}, or leave {by} out; the columns of the sets are always printed."
    )


def interval_columns(target: Target, interval: Interval) -> dict[str, Tensor]:
    """Return columns with the ends of intervals and the standard errors of the ends, (batch,) each.

    Angles are in degrees; their interval runs counter-clockwise from `low`, which is in [-180, 180), to `high`.
    """
    unit, end = (180 / math.pi, "_deg") if target.kind == "angle" else (1.0, "")
    return {
        f"{name}_{field}{end}": unit * values[:, index]
        for field, values in interval._asdict().items()
        for index, name in enumerate(target.names)
    }
