"""Metrics like those of other authors: correct ones, and ones with a planted fault that `mode=check` must find."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from framework.metric import Metric
from framework.prediction import Prediction
from framework.target import Target
from tests.planted_base import ChangedClass

ONE, THREE = Target("angle", ("azimuth",)), Target("angle", ("azimuth", "elevation", "tilt"))
HEIGHT, PLACE = Target("real", ("height",)), Target("real", ("x", "y"))
CLASSES = Target("class", ("a", "b", "c"))


def apart(one: Tensor, other: Tensor) -> Tensor:
    """Return the distances between angles the shorter way round, radians."""
    return torch.atan2((one - other).sin(), (one - other).cos()).abs()


class Kept(Metric):
    """Mean absolute error with its standard error, computed from the errors of all samples."""

    bibtex = ""
    columns = {"error": "error"}  # noqa: RUF012 - a metric as people write it
    better = {"error": "lower"}  # noqa: RUF012

    def __init__(self) -> None:
        super().__init__()
        self.add_state("seen", [], dist_reduce_fx="cat")

    def each(self, prediction: Prediction) -> Tensor:
        return (prediction.point.double() - prediction.target.double()).abs().mean(-1)

    def update(self, prediction: Prediction) -> None:
        self.seen.append(self.each(prediction))  # pyright: ignore[reportCallIssue, reportAttributeAccessIssue]

    def all(self) -> Tensor:
        seen: Any = self.seen
        if isinstance(seen, Tensor):
            return seen
        return torch.cat(list(seen)) if len(seen) else torch.empty(0, dtype=torch.float64)

    def spread(self, seen: Tensor) -> Tensor:
        return seen.std() / len(seen) ** 0.5 if len(seen) > 1 else seen.new_tensor(math.nan)

    def compute(self) -> dict[str, Tensor]:
        seen = self.all()
        return {"error": seen.mean(), "error_sem": self.spread(seen)}


class Plain(Kept):
    """Mean absolute error without a standard error."""

    def compute(self) -> dict[str, Tensor]:
        return {"error": self.all().mean()}


class Turned(Kept):
    """Mean distance between angles, degrees."""

    columns = {"turned_deg": "turned °"}  # noqa: RUF012
    better = {"turned_deg": "lower"}  # noqa: RUF012

    def each(self, prediction: Prediction) -> Tensor:
        return apart(prediction.point.double(), prediction.target.double()).rad2deg().mean(-1)

    def compute(self) -> dict[str, Tensor]:
        seen = self.all()
        return {"turned_deg": seen.mean(), "turned_deg_sem": self.spread(seen)}


class Within(Kept):
    """Share of predictions within 0.5 of the target, in the target's unit."""

    columns = {"within": "within 0.5"}  # noqa: RUF012
    better = {"within": "higher"}  # noqa: RUF012

    def each(self, prediction: Prediction) -> Tensor:
        return (super().each(prediction) < 0.5).double()

    def compute(self) -> dict[str, Tensor]:
        seen = self.all()
        return {"within": seen.mean(), "within_sem": self.spread(seen)}


class Median(Kept):
    """Median absolute error with a standard error by the metric's own bootstrap."""

    def compute(self) -> dict[str, Tensor]:
        seen = self.all()
        if len(seen) < 2:
            return {
                "error": seen.median() if len(seen) else seen.mean(),
                "error_sem": seen.new_tensor(math.nan),
            }
        draws = torch.randint(len(seen), (400, len(seen)), generator=torch.Generator().manual_seed(1))
        ordered = seen.sort().values
        return {"error": ordered.quantile(0.5), "error_sem": ordered[draws].quantile(0.5, dim=-1).std()}


class Surprise(Kept):
    """Mean negative log-density, nats."""

    def each(self, prediction: Prediction) -> Tensor:
        return -prediction.log_prob.double()


class Rooted(Kept):
    """Root mean square error, with a standard error by the delta method."""

    columns = {"root": "root mean square"}  # noqa: RUF012
    better = {"root": "lower"}  # noqa: RUF012

    def each(self, prediction: Prediction) -> Tensor:
        return (prediction.point.double() - prediction.target.double()).square().mean(-1)

    def compute(self) -> dict[str, Tensor]:
        seen = self.all()
        root = seen.mean().sqrt()
        return {"root": root, "root_sem": self.spread(seen) / (2 * root)}


class Hit(Metric):
    """Share of targets that are the most likely class, computed from sums and without a standard error."""

    bibtex = ""
    columns = {"hit": "hit"}  # noqa: RUF012
    better = {"hit": "higher"}  # noqa: RUF012

    def __init__(self) -> None:
        super().__init__()
        for name in ("right", "count"):
            self.add_state(name, torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, prediction: Prediction) -> None:
        guess = prediction.class_probabilities.argmax(-1)
        self.right = self.right + (guess == prediction.target).sum()
        self.count = self.count + len(guess)

    def compute(self) -> dict[str, Tensor]:
        return {"hit": self.right / self.count}


RIGHT = {
    "mean with its error": (Kept, PLACE),
    "mean without": (Plain, HEIGHT),
    "degrees": (Turned, THREE),
    "a bound in the unit": (Within, HEIGHT),
    "a median with a bootstrap": (Median, HEIGHT),
    "nats": (Surprise, ONE),
    "nats of classes": (Surprise, CLASSES),
    "nats of reals": (Surprise, PLACE),
    "a root": (Rooted, PLACE),
    "a share of classes": (Hit, CLASSES),
}
"""Correct metrics and the targets that they evaluate."""


@dataclass(frozen=True)
class Fault(ChangedClass):
    """A metric with one planted fault.

    Attributes:
        target: target that the metric evaluates.
    """

    target: Target = HEIGHT

    def build(self) -> Metric:
        return self.kind()


def nothing_of(seen: Tensor) -> Tensor:
    return seen.new_tensor(math.nan)


def deviation_alone(metric: Kept, seen: Tensor) -> Tensor:
    return seen.std() if len(seen) > 1 else nothing_of(seen)


def half_interval(metric: Kept, seen: Tensor) -> Tensor:
    return 1.96 * Kept.spread(metric, seen)


def divided_by_count(metric: Kept, seen: Tensor) -> Tensor:
    return seen.std() / len(seen) if len(seen) > 1 else nothing_of(seen)


def in_radians(metric: Kept, seen: Tensor) -> Tensor:
    return Kept.spread(metric, seen).deg2rad()


def squares_error(metric: Kept) -> dict[str, Tensor]:
    seen = metric.all()
    return {"root": seen.mean().sqrt(), "root_sem": metric.spread(seen)}


def every_number(metric: Kept, prediction: Prediction) -> Tensor:
    return apart(prediction.point.double(), prediction.target.double()).rad2deg().flatten()


def no_wrap(metric: Kept, prediction: Prediction) -> Tensor:
    return (prediction.point.double() - prediction.target.double()).abs().rad2deg().mean(-1)


def wraps_once(metric: Kept, prediction: Prediction) -> Tensor:
    gap = (prediction.point.double() - prediction.target.double()).abs()
    return torch.where(gap > math.pi, (2 * math.pi - gap).abs(), gap).rad2deg().mean(-1)


def of_degrees(metric: Kept, prediction: Prediction) -> Tensor:
    return apart(prediction.point.double(), prediction.target.double().deg2rad()).rad2deg().mean(-1)


def radians(metric: Kept, prediction: Prediction) -> Tensor:
    return apart(prediction.point.double(), prediction.target.double()).mean(-1)


def unsaid_degrees(metric: Kept, prediction: Prediction) -> Tensor:
    return apart(prediction.point.double(), prediction.target.double()).rad2deg().mean(-1)


def overwritten(metric: Kept, prediction: Prediction) -> Tensor:
    return prediction.point.sub_(prediction.target).double().abs().mean(-1)


def wrapped_in_place(metric: Kept, prediction: Prediction) -> Tensor:
    prediction.batch["target"].remainder_(2 * math.pi)
    return Turned.each(metric, prediction)  # pyright: ignore[reportArgumentType]


def first_hundred(metric: Kept, prediction: Prediction) -> Tensor:
    return Kept.each(metric, prediction)[:100]


def jumps(metric: Kept, prediction: Prediction) -> Tensor:
    found = Kept.each(metric, prediction)
    return found + 0.1 * torch.cat([found[:1] * 0, found.diff().abs()])


def batch_mean(metric: Kept, prediction: Prediction) -> Tensor:
    found = Kept.each(metric, prediction)
    return found.mean(0, keepdim=True) if len(found) else found


def in_bits(metric: Kept, prediction: Prediction) -> Tensor:
    return -prediction.log_prob.double() / math.log(2)


def ignoring_nan(metric: Kept, prediction: Prediction) -> Tensor:
    found = Kept.each(metric, prediction)
    return found[~found.isnan()]


def nan_is_0(metric: Kept, prediction: Prediction) -> Tensor:
    return Kept.each(metric, prediction).nan_to_num(0.0)


def squares(metric: Kept) -> dict[str, Tensor]:
    seen = metric.all()
    return {"root": seen.mean(), "root_sem": metric.spread(seen)}


def last_ones(metric: Kept) -> Tensor:
    return Kept.all(metric)[-200:]


def outliers_cut(metric: Kept) -> Tensor:
    """Return the errors without those after the 50th that are large compared with the first 50."""
    seen = Kept.all(metric)
    return torch.cat([seen[:50], seen[50:][seen[50:] < 3 * seen[:50].mean()]]) if len(seen) > 50 else seen


def finished(metric: Any) -> dict[str, Tensor]:
    """Return the share, and overwrite the sum of hits with it."""
    metric.right = metric.right / metric.count
    return {"hit": metric.right}


def averaged_states(metric: Any) -> None:
    Metric.__init__(metric)
    for name in ("right", "count"):
        metric.add_state(name, torch.zeros((), dtype=torch.float64), dist_reduce_fx="mean")


def per_batch(metric: Any, prediction: Prediction) -> None:
    guess = prediction.class_probabilities.argmax(-1)
    if len(guess):
        metric.right = metric.right + (guess == prediction.target).double().mean()
        metric.count = metric.count + 1


SEM, TURNS, UNIT, NAN = "standard errors", "turns do not matter", "unit", "NaN is not hidden"
BATCHES, ORDER, LEFT = "batches do not matter", "order does not matter", "predictions are left as they are"
ALL_FAULTS = (
    Fault(
        "one remark is no tuple",
        "remarks are sentences",
        Kept,
        {"remarks": lambda metric: "Many are far."},
        HEIGHT,
    ),
    Fault(
        "remarks need a sample",
        "remarks are sentences",
        Kept,
        {"remarks": lambda metric: (f"The first is {metric.all()[0]}.",)},
        PLACE,
    ),
    Fault("± is the deviation of samples", SEM, Kept, {"spread": deviation_alone}, HEIGHT),
    Fault("± is half of an interval", SEM, Kept, {"spread": half_interval}, PLACE),
    Fault("± is divided by n, not by its root", SEM, Kept, {"spread": divided_by_count}, HEIGHT),
    Fault("± of degrees in radians", SEM, Turned, {"spread": in_radians}, ONE),
    Fault("± of a root is that of the square", SEM, Rooted, {"compute": squares_error}, PLACE),
    Fault("± counts every angle as a sample", SEM, Turned, {"each": every_number}, THREE),
    Fault("angles are not wrapped", TURNS, Turned, {"each": no_wrap}, ONE),
    Fault("angles are wrapped once", TURNS, Turned, {"each": wraps_once}, THREE),
    Fault("targets are taken for degrees", TURNS, Turned, {"each": of_degrees}, ONE),
    Fault("radians are called degrees", UNIT, Turned, {"each": radians}, THREE),
    Fault("degrees are not said", UNIT, Kept, {"each": unsaid_degrees}, ONE),
    Fault("bits are called nats, of classes", UNIT, Surprise, {"each": in_bits}, CLASSES),
    Fault("bits are called nats, of an angle", UNIT, Surprise, {"each": in_bits}, ONE),
    Fault("bits are called nats, of reals", UNIT, Surprise, {"each": in_bits}, PLACE),
    Fault("the root is forgotten", UNIT, Rooted, {"compute": squares}, PLACE),
    Fault("the point is overwritten", LEFT, Kept, {"each": overwritten}, PLACE),
    Fault("the target is wrapped in place", LEFT, Turned, {"each": wrapped_in_place}, ONE),
    Fault("a hundred of a batch", BATCHES, Kept, {"each": first_hundred}, HEIGHT),
    Fault("a mean of batches' means", BATCHES, Kept, {"each": batch_mean}, HEIGHT),
    Fault("shares of batches", BATCHES, Hit, {"update": per_batch}, CLASSES),
    Fault("the last two hundred", ORDER, Kept, {"all": last_ones}, HEIGHT),
    Fault("neighbours in a batch", ORDER, Kept, {"each": jumps}, PLACE),
    Fault("odd ones are cut", ORDER, Kept, {"all": outliers_cut}, HEIGHT),
    Fault("NaN is left out", NAN, Kept, {"each": ignoring_nan}, PLACE),
    Fault("NaN is 0", NAN, Kept, {"each": nan_is_0}, HEIGHT),
    Fault("computing divides the sum", "computing changes nothing", Hit, {"compute": finished}, CLASSES),
    Fault("merged states are averaged", "states merge", Hit, {"__init__": averaged_states}, CLASSES),
)
