"""Contract tests of a metric: one function for each property; each reports its worst case."""

import copy
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor
from torch.distributions import (
    Categorical,
    Distribution,
    Independent,
    MultivariateNormal,
    Normal,
    constraints,
)

from framework.distributions.circular import circular
from framework.distributions.protocol import estimate, exact_estimate, marginal, median, pick, take
from framework.errors import UserError
from framework.metric import Metric
from framework.prediction import Prediction, Split
from framework.target import Target
from framework.testing.balls import Ball, ball
from framework.testing.devices import OneDevice, Questions, on_one_device
from framework.testing.finding import SEED, Finding, Worst, examined
from framework.testing.heads import values
from framework.testing.metric_numbers import (
    SCALE,
    degrees,
    nats,
    not_hidden,
    same,
    scaled,
    standard_errors,
)
from framework.testing.rows import MetricRow

Make = Callable[[], Metric]
SAMPLES = 24
MANY = 261
"""Number of samples in one update, more than a test split is commonly fetched in; MANY_IMAGES for images."""
MANY_IMAGES = 72
CASES = 48
"""Number of test cases from which standard errors are resampled."""


class Cardioid(Distribution):
    """Density (1 + 2ρ cos(φ - μ)) / 2π of each angle (Mardia & Jupp 2000, §3.5.5), the simplest on the circle.

    Args:
        location: μ, (*batch, angle), radians.
        strength: 2ρ in (0, 1], (*batch); 1 everywhere by default, which is narrowest.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    def __init__(self, location: Tensor, strength: Tensor | None = None) -> None:
        self.location = location
        self.strength = torch.ones_like(location[..., 0]) if strength is None else strength.to(location)
        super().__init__(location.shape[:-1], location.shape[-1:], validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        return circular

    @property
    def mode(self) -> Tensor:
        return self.location

    def log_prob(self, value: Tensor) -> Tensor:
        # 1 + cos d = 2 cos²(d/2); kept above 0, where log_prob would be -∞ and no metric could be compared
        near = 2 * torch.cos((value - self.location) / 2).square()
        weight = self.strength.unsqueeze(-1)
        near = 1 - weight + weight * near
        return (near.clamp(min=1e-12).log() - math.log(2 * math.pi)).sum(-1)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape) + self.batch_shape + self.event_shape
        # with t = tan(θ/2) the density of strength 1 is ∝ 1/(1+t²)²: √3 t has Student's distribution with 3 degrees
        # of freedom
        like = {"dtype": self.location.dtype, "device": self.location.device}
        normal = torch.randn(4, *shape, **like)
        found = self.location + 2 * torch.atan(normal[0] / normal[1:].norm(dim=0))
        if (self.strength == 1).all():
            return found
        # 1 + s cos d = s (1 + cos d) + (1 - s): a mixture of the density of strength 1 and the uniform density
        anywhere = 2 * math.pi * torch.rand(shape, **like)
        chosen = torch.rand(shape, device=self.location.device)
        return torch.where(chosen < self.strength.unsqueeze(-1), found, anywhere)

    def entropy(self) -> Tensor:
        # log 2π - (1/2π) ∫ (1 + s cos d) log(1 + s cos d) = log 4π - 1 + r - log(1 + r) with r = √(1 - s²)
        root = (1 - self.strength.square()).sqrt()
        return self.event_shape[0] * (math.log(4 * math.pi) - 1 + root - torch.log1p(root))


estimate.register(Cardioid, exact_estimate)


@marginal.register
def _(density: Cardioid, index: int) -> Cardioid:
    return Cardioid(density.location[..., index : index + 1], density.strength)


@median.register
def _(density: Cardioid, samples: int) -> Tensor:
    return density.location


@pick.register
def _(density: Cardioid, index: Tensor) -> Cardioid:
    strength = take(density.strength.unsqueeze(-1), index)[..., 0]
    return Cardioid(take(density.location, index), strength)


def numbers_about(target: Target) -> int:
    """Return the size of the last dimension of the place that `density_about` reads."""
    return len(target.names) if target.kind == "class" else math.prod(target.event_shape)


def density_about(target: Target, place: Tensor, breadth: Tensor | None = None) -> Distribution:
    """Return the simplest density of the target's kind about a place (*batch, number); for classes the place is logits.

    Args:
        target: Target of the density.
        place: Location of the density, or logits of classes, (*batch, number).
        breadth: Factor on the width, 1 or more, (*batch); logits of classes are divided by it.
    """
    if target.kind == "angle":
        return Cardioid(place, None if breadth is None else 1 / breadth)
    if target.kind == "image":
        image = place.unflatten(-1, target.event_shape)
        wide = torch.ones_like(image) if breadth is None else breadth[..., None, None, None].expand_as(image)
        return Independent(Normal(image, wide.to(image), validate_args=False), 3, validate_args=False)
    if target.kind == "real":
        # MultivariateNormal, since Independent refuses empty batches
        scale = torch.eye(place.shape[-1], dtype=place.dtype, device=place.device)
        if breadth is not None and breadth.numel():  # torch refuses a batch of 0 matrices
            scale = scale * breadth[..., None, None].to(place)
        return MultivariateNormal(place, scale_tril=scale, validate_args=False)
    return Categorical(
        logits=place if breadth is None else place / breadth.unsqueeze(-1), validate_args=False
    )


def examine_metric(row: MetricRow, build: Make) -> Iterator[Finding]:
    """Yield one finding for each property of a metric on predictions of `row.target`."""
    reads = bool(build().reads)
    whole = predictions(row, SAMPLES, images=reads)
    many, kind = Many(build, row, images=reads), row.target.kind
    checks: dict[str, tuple[float, Callable[[Worst], None]]] = {
        "on the device of its inputs": (0.0, lambda worst: _on_one_device(build, whole, worst)),
        "named numbers": (0.0, lambda worst: _named(build, whole, worst)),
        "nothing seen is NaN": (0.0, lambda worst: _nothing(build, whole, worst)),
        "batches do not matter": (1e-9, lambda worst: _batches(build, whole, many, worst)),
        "order does not matter": (1e-9, lambda worst: _order(build, whole, many, worst)),
        "states merge": (1e-9, lambda worst: _merge(build, whole, worst)),
        "reset and copy": (0.0, lambda worst: _reset(build, whole, worst)),
        "computing changes nothing": (1e-9, lambda worst: _computed_twice(build, whole, worst)),
        "predictions are left as they are": (0.0, lambda worst: _untouched(build, whole, worst)),
        "perfect beats random": (0.0, lambda worst: _perfect(build, row, worst)),
        "standard errors": (math.log(1.3), lambda worst: _standard_errors(build, row, worst)),
    }
    if kind == "angle":
        checks["turns do not matter"] = (1e-6, lambda worst: _turns(build, row, worst))
    if not reads:
        checks["unit"] = (0.0, lambda worst: _unit(build, row, worst))
        checks["NaN is not hidden"] = (0.0, lambda worst: _nan(build, row, worst))
    else:
        checks["only the images it names"] = (0.0, lambda worst: _images(build, whole, worst))
    for name, (limit, check) in checks.items():
        if name not in row.leave_out:
            yield examined(name, row.limits.get(name, limit), check)


@dataclass(frozen=True)
class Predictions:
    """Predictions for a fixed set of samples, as a function of sample indices and a split.

    Attributes:
        row: Row of the contract, which states the target and the image size.
        target: Target of each sample.
        place: Place of the density of each sample, as `density_about` reads it.
        breadth: Factor on the widths of the densities of the test split; None for the narrowest.
        outliers: Factor on the widths of the densities of outliers. An outlier has the place of the next sample, so
            that no two predictions of one index have the same place.
        fields: Further fields of the batch.
        images: Whether the predictions have images; they show balls.
    """

    row: MetricRow
    target: Tensor
    place: Tensor
    breadth: Tensor | None
    outliers: Tensor
    fields: dict[str, Tensor]
    images: bool

    def __call__(self, index: Tensor, split: Split) -> Prediction:
        """Return the prediction of these samples of a split."""
        about, breadth = self.place[index], None if self.breadth is None else self.breadth[index]
        if split == "outliers":
            about = self.place[(index + 1) % len(self.target)]
            breadth = self.outliers[index] * (1 if breadth is None else breadth)
        density = density_about(self.row.target, about, breadth)
        if self.images:
            density = Ball(density, about.float(), self.row.size)
        batch = {"target": self.target[index], "index": index, "group": torch.zeros_like(index)}
        batch |= {name: field[index] for name, field in self.fields.items()}
        return Prediction(density, batch, split=split)


def predictions(row: MetricRow, count: int, *, images: bool, near: bool = False) -> Predictions:
    """Return predictions at random places or, if `near`, close to the targets.

    Predictions near the targets have a random difficulty for each sample, so that the errors of its numbers are
    correlated.
    """
    target = values(row.target, (count,))
    fields = {name: make(count) for name, make in row.fields.items()}
    if images:
        fields = {**ball(_place(row, target), row.size), **fields}
    generator = torch.Generator().manual_seed(SEED)
    shape = (count, numbers_about(row.target))
    place = torch.randn(shape, generator=generator)
    outliers = 1 + 2 * torch.rand(count, generator=generator)
    if near:
        hard = torch.randn(count, 1, generator=generator).abs()
        away = _place(row, target)
        place = away / 2 + place if row.target.kind == "class" else away + hard * (0.7 + 0.1 * place)
    return Predictions(row, target, place, None, outliers, fields, images)


Slices = Callable[[Tensor, Split], Prediction]


def _place(row: MetricRow, target: Tensor) -> Tensor:
    """Return the place of a density about the target, as `density_about` reads it; logits for classes."""
    return (
        3.0 * torch.nn.functional.one_hot(target, len(row.target.names))
        if row.target.kind == "class"
        else target.flatten(1)
    )


def _feed(metric: Metric, some: Slices, part: Tensor) -> None:
    """Update a metric with samples `part` of every split that it reads."""
    for split in metric.splits:
        metric.update(some(part, split))


def _after(build: Make, some: Slices, parts: Sequence[Tensor]) -> dict[str, Tensor]:
    metric = build()
    torch.manual_seed(SEED)
    for part in parts:
        _feed(metric, some, part)
    return metric.compute()


def _on_one_device(build: Make, some: "Predictions", worst: Worst) -> None:
    """Check two updates of every split, the numbers, and both again after a reset, for mixed devices."""

    def questions(mode: OneDevice) -> Questions:
        metric = build()
        mode.move(metric)
        fields = ("target", "place", "breadth", "outliers", "fields")
        received = replace(some, **mode.receive({name: getattr(some, name) for name in fields}))
        parts = mode.receive(list(torch.arange(SAMPLES // 2).split(SAMPLES // 4)))
        for part in parts:
            yield "update", lambda part=part: _feed(metric, received, part)
        yield "compute", metric.compute
        yield "reset", metric.reset
        yield "update after a reset", lambda: _feed(metric, received, parts[0])
        yield "compute after a reset", metric.compute

    on_one_device(questions, worst)


def _named(build: Make, some: Slices, worst: Worst) -> None:
    metric = build()
    found = _after(build, some, [torch.arange(SAMPLES)])
    worst.count(
        not set(metric.columns) <= set(found), f"columns {sorted(set(metric.columns) - set(found))} missing"
    )
    worst.count(not set(metric.better) <= set(metric.columns), f"better {sorted(metric.better)} of columns")
    for key, value in found.items():
        worst.same(f"shape of {key}", tuple(value.shape), ())
        worst.same(f"{key} is one number", value.numel(), 1)
    worst.count(
        all(value.isnan().item() for value in found.values()), "every number is NaN on ordinary predictions"
    )


def _nothing(build: Make, some: Slices, worst: Worst) -> None:
    for what, parts in {"no update": [], "an empty batch": [torch.arange(0)]}.items():
        for key, value in _quiet(build, some, parts).items():
            worst.count(not value.isnan().item(), f"{what}: {key} is {value.item():g}")


def _quiet(build: Make, some: Slices, parts: Sequence[Tensor]) -> dict[str, Tensor]:
    with warnings.catch_warnings():
        # torchmetrics warns of compute before update, which is tested here
        warnings.filterwarnings("ignore", message=".*compute.*before the.*update.*", category=UserWarning)
        return _after(build, some, parts)


class Many:
    """More predictions than a metric may be used to, and the numbers of all of them at once.

    Attributes:
        some: Predictions.
        index: Indices of all predictions.
    """

    def __init__(self, build: Make, row: MetricRow, *, images: bool) -> None:
        self.build = build
        dear = images or row.target.kind == "image"
        self.some = predictions(row, MANY_IMAGES if dear else MANY, images=images)
        self.index = torch.arange(len(self.some.target))

    @cached_property
    def at_once(self) -> dict[str, Tensor]:
        """Return the numbers after one update with all predictions."""
        return _after(self.build, self.some, [self.index])


def _batches(build: Make, some: Slices, many: Many, worst: Worst) -> None:
    index = torch.arange(SAMPLES)
    wanted = _after(build, some, [index])
    same("in batches of 7", _after(build, some, index.split(7)), wanted, worst)
    same("one by one", _after(build, some, index.split(1)), wanted, worst)
    count, half = len(many.index), len(many.index) // 2
    parts = many.index.split([1, half + 3, count - half - 4])
    same(f"{count} in uneven parts", _after(build, many.some, parts), many.at_once, worst)


def _order(build: Make, some: Slices, many: Many, worst: Worst) -> None:
    index = torch.arange(SAMPLES)
    same("backwards", _after(build, some, [index.flip(0)]), _after(build, some, [index]), worst)
    order = torch.randperm(len(many.index), generator=torch.Generator().manual_seed(SEED))
    same(f"{len(order)} shuffled", _after(build, many.some, [order]), many.at_once, worst)


def _merge(build: Make, some: Slices, worst: Worst) -> None:
    """Check that the states of two processes, merged by torchmetrics, give the numbers of all samples."""
    first, second = build(), build()
    _feed(first, some, torch.arange(10))
    _feed(second, some, torch.arange(10, SAMPLES))
    first.merge_state(second)
    same("two halves merged", first.compute(), _after(build, some, [torch.arange(SAMPLES)]), worst)


def _reset(build: Make, some: Slices, worst: Worst) -> None:
    index = torch.arange(SAMPLES)
    metric = build()
    _feed(metric, some, index[:5])
    metric.reset()
    _feed(metric, some, index)
    wanted = _after(build, some, [index])
    same("after a reset", metric.compute(), wanted, worst)
    same("of a copy", copy.deepcopy(metric).compute(), wanted, worst)


def _perfect(build: Make, row: MetricRow, worst: Worst) -> None:
    """Check that a density about the target is judged better than a density about another place.

    All columns of `better` are compared. For a metric that reads outliers, densities of outliers are broader in the
    first case, and as narrow as those of test samples in the second.
    """
    metric = build()
    some = predictions(row, SAMPLES, images=bool(metric.reads))
    index = torch.arange(SAMPLES)
    breadth = torch.full((SAMPLES,), 2.0)

    def about(location: Tensor, outliers: Tensor | None) -> dict[str, Tensor]:
        batch = some(index, "test").batch
        location = _place(row, location)
        judged = build()
        for split in judged.splits:
            density = density_about(row.target, location.float(), outliers if split == "outliers" else None)
            if judged.reads:
                density = Ball(density, location.float(), row.size)
            judged.update(Prediction(density, batch, split=split))
        return judged.compute()

    target = some(index, "test").target
    elsewhere = (target + 1) % len(row.target.names) if row.target.kind == "class" else target + 2.0
    good, bad = about(target, breadth), about(elsewhere, None)
    worst.count(False, "no column has a better way")
    for key, way in metric.better.items():
        ahead = good[key] - bad[key] if way == "higher" else bad[key] - good[key]
        told = f"{key}: {good[key].item():.4g} about the target, {bad[key].item():.4g} elsewhere"
        worst.count(not (ahead > 0 or good[key].isnan().item()), told)


def _computed_twice(build: Make, some: Slices, worst: Worst) -> None:
    """Check that `compute` after every batch, and twice in a row, does not change the numbers."""
    index = torch.arange(SAMPLES)
    wanted = _after(build, some, index.split(10))
    metric = build()
    torch.manual_seed(SEED)
    for part in index.split(10):
        _feed(metric, some, part)
        metric.compute()
    same("computed after every batch", metric.compute(), wanted, worst)
    metric.update(some(index[:0], metric.splits[0]))  # so that torchmetrics does not return the cached result
    same("computed again", metric.compute(), wanted, worst)


def _untouched(build: Make, some: Slices, worst: Worst) -> None:
    """Check that a metric leaves the prediction as it is, since other metrics read the same one."""
    metric, index = build(), torch.arange(SAMPLES)
    for split in metric.splits:
        seen = some(index, split)
        torch.manual_seed(SEED)
        for derived in ("log_prob", "estimate", "class_probabilities", "entropy", "point"):
            try:
                getattr(seen, derived)
            except (UserError, NotImplementedError):
                continue
        before = {name: value.clone() for name, value in _tensors(seen).items()}
        metric.update(seen)
        after = _tensors(seen)
        worst.same("fields of the batch", sorted(after.keys() & before.keys()), sorted(before))
        for name in before.keys() & after.keys():
            worst.same_bits(f"{name} after an update", after[name], before[name])


def _tensors(prediction: Prediction) -> dict[str, Tensor]:
    """Return the tensors of the batch and the density of a prediction, and those derived from both, by name."""
    found = {f"batch[{name!r}]": value for name, value in prediction.batch.items()}
    for owner in (prediction, prediction.density):
        for name, value in vars(owner).items():
            if isinstance(value, Tensor):
                found[name.lstrip("_")] = value
    return found


def _standard_errors(build: Make, row: MetricRow, worst: Worst) -> None:
    images = bool(build().reads)
    count = CASES // 2 if images or row.target.kind == "image" else CASES
    some = predictions(row, count, images=images, near=True)
    standard_errors(lambda index: _after(build, some, [index]), count, worst)


def _turns(build: Make, row: MetricRow, worst: Worst) -> None:
    """Check that whole turns of predicted or true angles change nothing; in float64, where they round little."""
    some = predictions(row, SAMPLES, images=bool(build().reads))
    some = replace(some, target=some.target.double(), place=some.place.double())
    index = torch.arange(SAMPLES)
    wanted = _after(build, some, [index])
    generator = torch.Generator().manual_seed(SEED)
    turns = 2 * math.pi * torch.randint(-3, 4, (2, *some.target.shape), generator=generator).double()
    for what, other in {
        "targets": replace(some, target=some.target + turns[0]),
        "predicted angles": replace(some, place=some.place + turns[1]),
    }.items():
        same(f"whole turns of {what}", _after(build, other, [index]), wanted, worst)


def _unit(build: Make, row: MetricRow, worst: Worst) -> None:
    """Check degrees against radians, nats against bits, and that numbers of reals follow their target's unit."""
    index, kind = torch.arange(SAMPLES), row.target.kind
    some = predictions(row, SAMPLES, images=False, near=True)
    metric = build()
    columns = metric.columns
    if kind in ("class", "angle"):
        place = torch.zeros_like(some.place)
        flat = replace(some, place=place, breadth=torch.full((SAMPLES,), 1e15))
        nats(columns, row.target, _after(build, flat, [index]), worst)
    if kind == "angle":
        anywhere = predictions(row, SAMPLES, images=False)
        off, far = (replace(some, place=some.target.double() + far) for far in (1.0, 2.0))
        wide = [_after(build, other, [index]) for other in (anywhere, some, far)]
        degrees(columns, wide, _after(build, off, [index]), worst)
    if kind == "real":
        first, other, again = (
            replace(
                some,
                target=some.target.double() * scale,
                place=some.place.double() * scale,
                breadth=torch.full((SAMPLES,), scale, dtype=torch.float64),
            )
            for scale in (1.0, SCALE, SCALE**2)
        )
        wanted, found, more = (_after(build, one, [index]) for one in (first, other, again))
        scaled(columns, found, more, wanted, len(row.target.names), worst)
    worst.count(False, "nothing has a unit")


def _nan(build: Make, row: MetricRow, worst: Worst) -> None:
    some = predictions(row, SAMPLES, images=False, near=True)
    bad = slice(5, 13)  # so many that a median changes

    def judge(place: float | Tensor, breadth: float) -> dict[str, Tensor]:
        places, breadths = some.place.clone(), torch.ones(SAMPLES)
        places[bad] += place
        breadths[bad] = breadth
        return _after(build, replace(some, place=places, breadth=breadths), [index])

    index, metric = torch.arange(SAMPLES), build()
    without = _after(build, some, [torch.cat([index[: bad.start], index[bad.stop :]])])
    not_hidden(
        lambda: judge(math.nan, math.nan),
        judge(0.0, 1.0),
        judge(torch.arange(1.0, 1.0 + some.place.shape[1]), 2.0),
        without,
        metric.columns,
        metric.better,
        worst,
    )


def _images(build: Make, some: Slices, worst: Worst) -> None:
    """Check that exactly the images of `reads` are drawn, each once and alone, as the prediction announces none."""
    metric, prediction = build(), some(torch.arange(SAMPLES), build().splits[0])
    metric.update(prediction)
    asked = prediction.density.asked  # type: ignore[attr-defined]  # a Ball
    worst.same("images drawn", sorted(map(sorted, asked)), sorted([name] for name in metric.reads))
