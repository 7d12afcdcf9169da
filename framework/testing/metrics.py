"""Contract tests of a metric: one function for each property; each records its largest error."""

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
from framework.errors import UserError, shorten
from framework.metric import Metric
from framework.prediction import Prediction, Split
from framework.target import Target
from framework.testing.balls import Ball, ball
from framework.testing.devices import Calls, OneDevice, check_devices
from framework.testing.finding import SEED, Finding, Worst, run_check
from framework.testing.head_subject import values
from framework.testing.metric_numbers import (
    SCALE,
    check_degrees,
    check_nan_visible,
    check_nats,
    check_same,
    check_scaling,
    check_standard_errors,
)
from framework.testing.rows import MetricRow

Make = Callable[[], Metric]
SAMPLES = 24
"""Number of samples in most checks."""
MANY = 261
"""Number of samples in a large update, larger than common batch sizes."""
MANY_IMAGES = 72
"""Number of images in a large update."""
CASES = 48
"""Number of test cases with which standard errors are checked."""


class Cardioid(Distribution):
    """Density (1 + 2ρ cos(φ - μ)) / 2π of independent angles φ (Mardia & Jupp 2000, §3.5.5).

    Args:
        location: μ, (*batch, angle), radians.
        strength: 2ρ in (0, 1], (*batch); 1 everywhere by default, which gives the narrowest densities.
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
        # 1 + cos d = 2 cos²(d/2); a lower bound keeps log_prob finite, so that metrics can be compared
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
        narrow = self.location + 2 * torch.atan(normal[0] / normal[1:].norm(dim=0))
        if (self.strength == 1).all():
            return narrow
        # 1 + s cos d = s (1 + cos d) + (1 - s): a mixture of the density of strength 1 and the uniform density
        anywhere = 2 * math.pi * torch.rand(shape, **like)
        chosen = torch.rand(shape, device=self.location.device)
        return torch.where(chosen < self.strength.unsqueeze(-1), narrow, anywhere)

    def entropy(self) -> Tensor:
        # log 2π - (1/2π) ∫ (1 + s cos d) log(1 + s cos d) = log 4π - 1 + r - log(1 + r) with r = √(1 - s²)
        # the lower bound keeps the gradient of the root finite at s = 1
        root = (1 - self.strength.square()).clamp(min=torch.finfo(self.strength.dtype).tiny).sqrt()
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


def place_size(target: Target) -> int:
    """Return the length of `place` for one sample in `simplest_density`."""
    return len(target.names) if target.kind == "class" else math.prod(target.event_shape)


def simplest_density(target: Target, place: Tensor, breadth: Tensor | None = None) -> Distribution:
    """Return a simple density for a target: cardioid, normal or categorical.

    Args:
        target: Target of the density.
        place: Location of the density, or logits of classes, (*batch, number).
        breadth: Factor on the width of the density, 1 or more, (*batch); logits of classes are divided by it.
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
    """Yield one finding for each property of a metric, for predictions of the row's target.

    Args:
        row: Contract row of the metric.
        build: Function that returns a new metric.
    """
    reads = bool(build().reads)
    whole = predictions(row, SAMPLES, images=reads)
    many, kind = Many(build, row, images=reads), row.target.kind
    checks: dict[str, tuple[float, Callable[[Worst], None]]] = {
        "on the device of its inputs": (0.0, lambda worst: _on_one_device(build, whole, worst)),
        "named numbers": (0.0, lambda worst: _column_names(build, whole, worst)),
        "NaN without samples": (0.0, lambda worst: _no_samples(build, whole, worst)),
        "remarks are sentences": (0.0, lambda worst: _remarks(build, whole, worst)),
        "batches do not matter": (1e-9, lambda worst: _batches(build, whole, many, worst)),
        "order does not matter": (1e-9, lambda worst: _order(build, whole, many, worst)),
        "states merge": (1e-9, lambda worst: _merge(build, whole, worst)),
        "reset and copy": (0.0, lambda worst: _reset(build, whole, worst)),
        "computing changes nothing": (1e-9, lambda worst: _computed_twice(build, whole, worst)),
        "predictions are left as they are": (0.0, lambda worst: _prediction_unchanged(build, whole, worst)),
        "perfect beats random": (0.0, lambda worst: _perfect(build, row, worst)),
        "standard errors": (math.log(1.3), lambda worst: _standard_errors(build, row, worst)),
    }
    if kind == "angle":
        checks["turns do not matter"] = (1e-6, lambda worst: _turns(build, row, worst))
    if not reads:
        checks["unit"] = (0.0, lambda worst: _unit(build, row, worst))
        checks["NaN is not hidden"] = (0.0, lambda worst: _nan(build, row, worst))
    else:
        checks["only the images in reads are drawn"] = (0.0, lambda worst: _images(build, whole, worst))
    for name, (limit, check) in checks.items():
        if name not in row.leave_out:
            yield run_check(name, row.limits.get(name, limit), check)


@dataclass(frozen=True)
class Predictions:
    """Artificial predictions for a fixed set of samples, callable with sample indices and the name of a split.

    Attributes:
        row: Contract row, which states the target and the image size.
        target: Target of each sample.
        place: Location of the density of each sample, as `simplest_density` reads it.
        breadth: Factor on the widths of the densities; None for 1.
        outliers: Further factor on the widths in the split "outliers". An outlier has the location of the next sample,
            so that the test sample and the outlier with the same index differ in location.
        fields: Further fields of the batch.
        images: True if the predicted densities have images (`protocol.images`); each image shows a ball.
    """

    row: MetricRow
    target: Tensor
    place: Tensor
    breadth: Tensor | None
    outliers: Tensor
    fields: dict[str, Tensor]
    images: bool

    def __call__(self, index: Tensor, split: Split) -> Prediction:
        """Return the prediction for the samples with the indices `index` in a split."""
        location, breadth = self.place[index], None if self.breadth is None else self.breadth[index]
        if split == "outliers":
            location = self.place[(index + 1) % len(self.target)]
            breadth = self.outliers[index] * (1 if breadth is None else breadth)
        density = simplest_density(self.row.target, location, breadth)
        if self.images:
            density = Ball(density, location.float(), self.row.size)
        batch = {"target": self.target[index], "index": index, "group": torch.zeros_like(index)}
        batch |= {name: field[index] for name, field in self.fields.items()}
        return Prediction(density, batch, split=split)


def predictions(row: MetricRow, count: int, *, images: bool, near: bool = False) -> Predictions:
    """Return `count` predictions at random locations or, if `near`, close to the targets.

    If `near`, each sample has a random difficulty, so that the errors of the numbers of its target are correlated.

    Args:
        row: Contract row of the metric.
        count: Number of samples.
        images: True if the predictions have images.
        near: True for locations close to the targets.
    """
    target = values(row.target, (count,))
    fields = {name: make(count) for name, make in row.fields.items()}
    if images:
        fields = {**ball(_place(row, target), row.size), **fields}
    generator = torch.Generator().manual_seed(SEED)
    shape = (count, place_size(row.target))
    place = torch.randn(shape, generator=generator)
    outliers = 1 + 2 * torch.rand(count, generator=generator)
    if near:
        difficulty = torch.randn(count, 1, generator=generator).abs()
        center = _place(row, target)
        place = (
            center / 2 + place if row.target.kind == "class" else center + difficulty * (0.7 + 0.1 * place)
        )
    return Predictions(row, target, place, None, outliers, fields, images)


Predict = Callable[[Tensor, Split], Prediction]
"""Function from sample indices and a split to the prediction."""


def _place(row: MetricRow, target: Tensor) -> Tensor:
    """Return the `place` of a density at the target, as `simplest_density` reads it."""
    return (
        3.0 * torch.nn.functional.one_hot(target, len(row.target.names))
        if row.target.kind == "class"
        else target.flatten(1)
    )


def _update(metric: Metric, predict: Predict, indices: Tensor) -> None:
    """Update a metric with the samples of these indices, for every split that it reads."""
    for split in metric.splits:
        metric.update(predict(indices, split))


def _compute(build: Make, predict: Predict, parts: Sequence[Tensor]) -> dict[str, Tensor]:
    """Return the numbers of a new metric after one update for each tensor of sample indices in `parts`."""
    metric = build()
    torch.manual_seed(SEED)
    for part in parts:
        _update(metric, predict, part)
    return metric.compute()


def _on_one_device(build: Make, predict: "Predictions", worst: Worst) -> None:
    """Check that updates, numbers, and both after a reset mix no devices."""

    def calls(mode: OneDevice) -> Calls:
        metric = build()
        mode.label_module(metric)
        fields = ("target", "place", "breadth", "outliers", "fields")
        received = replace(predict, **mode.label_device({name: getattr(predict, name) for name in fields}))
        parts = mode.label_device(list(torch.arange(SAMPLES // 2).split(SAMPLES // 4)))
        for part in parts:
            yield "update", lambda part=part: _update(metric, received, part)
        yield "compute", metric.compute
        yield "reset", metric.reset
        yield "update after a reset", lambda: _update(metric, received, parts[0])
        yield "compute after a reset", metric.compute

    check_devices(calls, worst)


def _column_names(build: Make, predict: Predict, worst: Worst) -> None:
    metric = build()
    numbers = _compute(build, predict, [torch.arange(SAMPLES)])
    worst.count(
        not set(metric.columns) <= set(numbers),
        f"columns {sorted(set(metric.columns) - set(numbers))} are not computed",
    )
    worst.count(
        not set(metric.better) <= set(metric.columns),
        f"better names {sorted(metric.better)}, which must be columns",
    )
    for key, value in numbers.items():
        worst.same(f"shape of {key}", tuple(value.shape), ())
        worst.same(f"number of values of {key}", value.numel(), 1)
    worst.count(
        all(value.isnan().item() for value in numbers.values()),
        "every number is NaN for ordinary predictions",
    )


def _remarks(build: Make, predict: Predict, worst: Worst) -> None:
    """Check that the remarks are a tuple of strings, with samples and without; a string would be logged by letters."""
    for situation, parts in {"no update": [], "ordinary predictions": [torch.arange(SAMPLES)]}.items():
        metric = build()
        torch.manual_seed(SEED)
        for part in parts:
            _update(metric, predict, part)
        remarks: object = metric.remarks()
        is_tuple = isinstance(remarks, tuple) and all(isinstance(remark, str) for remark in remarks)
        worst.count(
            not is_tuple,
            f"{situation}: remarks returns {shorten(repr(remarks), 60)}, expected a tuple of strings",
        )


def _no_samples(build: Make, predict: Predict, worst: Worst) -> None:
    for situation, parts in {"no update": [], "an empty batch": [torch.arange(0)]}.items():
        for key, value in _compute_quietly(build, predict, parts).items():
            worst.count(not value.isnan().item(), f"{situation}: {key} is {value.item():g}")


def _compute_quietly(build: Make, predict: Predict, parts: Sequence[Tensor]) -> dict[str, Tensor]:
    with warnings.catch_warnings():
        # torchmetrics warns of compute before update, which this check does on purpose
        warnings.filterwarnings("ignore", message=".*compute.*before the.*update.*", category=UserWarning)
        return _compute(build, predict, parts)


class Many:
    """Many predictions, and the numbers that a metric computes from all of them.

    Args:
        build: Function that returns a new metric.
        row: Contract row of the metric.
        images: True if the predictions have images.

    Attributes:
        predictions: The predictions.
        index: Indices of all predictions.
    """

    def __init__(self, build: Make, row: MetricRow, *, images: bool) -> None:
        self.build = build
        slow = images or row.target.kind == "image"
        self.predictions = predictions(row, MANY_IMAGES if slow else MANY, images=images)
        self.index = torch.arange(len(self.predictions.target))

    @cached_property
    def at_once(self) -> dict[str, Tensor]:
        """Numbers of the metric after one update with all predictions."""
        return _compute(self.build, self.predictions, [self.index])


def _batches(build: Make, predict: Predict, many: Many, worst: Worst) -> None:
    index = torch.arange(SAMPLES)
    expected = _compute(build, predict, [index])
    check_same("in batches of 7", _compute(build, predict, index.split(7)), expected, worst)
    check_same("one by one", _compute(build, predict, index.split(1)), expected, worst)
    count, half = len(many.index), len(many.index) // 2
    parts = many.index.split([1, half + 3, count - half - 4])
    check_same(
        f"{count} samples in uneven batches", _compute(build, many.predictions, parts), many.at_once, worst
    )


def _order(build: Make, predict: Predict, many: Many, worst: Worst) -> None:
    index = torch.arange(SAMPLES)
    check_same(
        "in reverse order",
        _compute(build, predict, [index.flip(0)]),
        _compute(build, predict, [index]),
        worst,
    )
    order = torch.randperm(len(many.index), generator=torch.Generator().manual_seed(SEED))
    check_same(
        f"{len(order)} samples in random order",
        _compute(build, many.predictions, [order]),
        many.at_once,
        worst,
    )


def _merge(build: Make, predict: Predict, worst: Worst) -> None:
    """Check that the states of two metrics, merged by torchmetrics, give the numbers of all samples."""
    first, second = build(), build()
    _update(first, predict, torch.arange(10))
    _update(second, predict, torch.arange(10, SAMPLES))
    first.merge_state(second)
    check_same(
        "merged states of two parts",
        first.compute(),
        _compute(build, predict, [torch.arange(SAMPLES)]),
        worst,
    )


def _reset(build: Make, predict: Predict, worst: Worst) -> None:
    index = torch.arange(SAMPLES)
    metric = build()
    _update(metric, predict, index[:5])
    metric.reset()
    _update(metric, predict, index)
    expected = _compute(build, predict, [index])
    check_same("after a reset", metric.compute(), expected, worst)
    check_same("of a copy", copy.deepcopy(metric).compute(), expected, worst)


def _perfect(build: Make, row: MetricRow, worst: Worst) -> None:
    """Check that densities at the targets give better numbers than densities at other locations.

    All columns of `better` are compared. For a metric that reads outliers, the densities of outliers are broader than
    those of the test samples if these are at the targets, and equally broad if these are at other locations.
    """
    metric = build()
    predicted = predictions(row, SAMPLES, images=bool(metric.reads))
    index = torch.arange(SAMPLES)
    breadth = torch.full((SAMPLES,), 2.0)

    def compute_at(location: Tensor, outliers: Tensor | None) -> dict[str, Tensor]:
        batch = predicted(index, "test").batch
        location = _place(row, location)
        new_metric = build()
        for split in new_metric.splits:
            density = simplest_density(
                row.target, location.float(), outliers if split == "outliers" else None
            )
            if new_metric.reads:
                density = Ball(density, location.float(), row.size)
            new_metric.update(Prediction(density, batch, split=split))
        return new_metric.compute()

    target = predicted(index, "test").target
    elsewhere = (target + 1) % len(row.target.names) if row.target.kind == "class" else target + 2.0
    good, bad = compute_at(target, breadth), compute_at(elsewhere, None)
    worst.count(False, "no column has a better direction")
    for key, direction in metric.better.items():
        gain = good[key] - bad[key] if direction == "higher" else bad[key] - good[key]
        description = (
            f"{key}: {good[key].item():.4g} for densities at the targets, {bad[key].item():.4g} elsewhere"
        )
        worst.count(not (gain > 0 or good[key].isnan().item()), description)


def _computed_twice(build: Make, predict: Predict, worst: Worst) -> None:
    """Check that calling `compute` after every batch, and twice in a row, does not change the numbers."""
    index = torch.arange(SAMPLES)
    expected = _compute(build, predict, index.split(10))
    metric = build()
    torch.manual_seed(SEED)
    for part in index.split(10):
        _update(metric, predict, part)
        metric.compute()
    check_same("computed after every batch", metric.compute(), expected, worst)
    metric.update(
        predict(index[:0], metric.splits[0])
    )  # so that torchmetrics does not return its cached result
    check_same("computed again", metric.compute(), expected, worst)


def _prediction_unchanged(build: Make, predict: Predict, worst: Worst) -> None:
    """Check that an update does not change the prediction, since other metrics read the same prediction."""
    metric, index = build(), torch.arange(SAMPLES)
    for split in metric.splits:
        prediction = predict(index, split)
        torch.manual_seed(SEED)
        for derived in ("log_prob", "estimate", "class_probabilities", "entropy", "point"):
            try:
                getattr(prediction, derived)
            except (UserError, NotImplementedError):
                continue
        before = {name: value.clone() for name, value in _tensors(prediction).items()}
        metric.update(prediction)
        after = _tensors(prediction)
        worst.same("fields of the batch", sorted(after.keys() & before.keys()), sorted(before))
        for name in before.keys() & after.keys():
            worst.same_bits(f"{name} after an update", after[name], before[name])


def _tensors(prediction: Prediction) -> dict[str, Tensor]:
    """Return name → tensor, for the batch, the density and the derived quantities of a prediction."""
    tensors = {f"batch[{name!r}]": value for name, value in prediction.batch.items()}
    for owner in (prediction, prediction.density):
        for name, value in vars(owner).items():
            if isinstance(value, Tensor):
                tensors[name.lstrip("_")] = value
    return tensors


def _standard_errors(build: Make, row: MetricRow, worst: Worst) -> None:
    images = bool(build().reads)
    count = CASES // 2 if images or row.target.kind == "image" else CASES
    predicted = predictions(row, count, images=images, near=True)
    check_standard_errors(lambda index: _compute(build, predicted, [index]), count, worst)


def _turns(build: Make, row: MetricRow, worst: Worst) -> None:
    """Check in float64 that whole turns added to predicted or true angles do not change the numbers."""
    predicted = predictions(row, SAMPLES, images=bool(build().reads))
    predicted = replace(predicted, target=predicted.target.double(), place=predicted.place.double())
    index = torch.arange(SAMPLES)
    expected = _compute(build, predicted, [index])
    generator = torch.Generator().manual_seed(SEED)
    turns = 2 * math.pi * torch.randint(-3, 4, (2, *predicted.target.shape), generator=generator).double()
    for changed, other in {
        "targets": replace(predicted, target=predicted.target + turns[0]),
        "predicted angles": replace(predicted, place=predicted.place + turns[1]),
    }.items():
        check_same(f"whole turns added to {changed}", _compute(build, other, [index]), expected, worst)


def _unit(build: Make, row: MetricRow, worst: Worst) -> None:
    """Check the units of numbers: degrees only if a name says so, nats and not bits, and the unit of real targets."""
    index, kind = torch.arange(SAMPLES), row.target.kind
    predicted = predictions(row, SAMPLES, images=False, near=True)
    metric = build()
    columns = metric.columns
    if kind in ("class", "angle"):
        place = torch.zeros_like(predicted.place)
        flat = replace(predicted, place=place, breadth=torch.full((SAMPLES,), 1e15))
        check_nats(columns, row.target, _compute(build, flat, [index]), worst)
    if kind == "angle":
        anywhere = predictions(row, SAMPLES, images=False)
        off, far = (replace(predicted, place=predicted.target.double() + far) for far in (1.0, 2.0))
        wide = [_compute(build, second, [index]) for second in (anywhere, predicted, far)]
        check_degrees(columns, wide, _compute(build, off, [index]), worst)
    if kind == "real":
        first, second, third = (
            replace(
                predicted,
                target=predicted.target.double() * scale,
                place=predicted.place.double() * scale,
                breadth=torch.full((SAMPLES,), scale, dtype=torch.float64),
            )
            for scale in (1.0, SCALE, SCALE**2)
        )
        first_numbers, second_numbers, third_numbers = (
            _compute(build, scaled_predictions, [index]) for scaled_predictions in (first, second, third)
        )
        check_scaling(columns, second_numbers, third_numbers, first_numbers, len(row.target.names), worst)
    worst.count(False, "no number has a unit")


def _nan(build: Make, row: MetricRow, worst: Worst) -> None:
    predicted = predictions(row, SAMPLES, images=False, near=True)
    bad = slice(5, 13)  # enough samples to change a median

    def evaluate(place: float | Tensor, breadth: float) -> dict[str, Tensor]:
        places, breadths = predicted.place.clone(), torch.ones(SAMPLES)
        places[bad] += place
        breadths[bad] = breadth
        return _compute(build, replace(predicted, place=places, breadth=breadths), [index])

    index, metric = torch.arange(SAMPLES), build()
    without = _compute(build, predicted, [torch.cat([index[: bad.start], index[bad.stop :]])])
    check_nan_visible(
        lambda: evaluate(math.nan, math.nan),
        evaluate(0.0, 1.0),
        evaluate(torch.arange(1.0, 1.0 + predicted.place.shape[1]), 2.0),
        without,
        metric.columns,
        metric.better,
        worst,
    )


def _images(build: Make, predict: Predict, worst: Worst) -> None:
    """Check that the metric requests each image in `reads` once, in a call of its own, and no other image."""
    metric, prediction = build(), predict(torch.arange(SAMPLES), build().splits[0])
    metric.update(prediction)
    requested = prediction.density.requested_channels  # type: ignore[attr-defined]  # a Ball
    worst.same("images drawn", sorted(map(sorted, requested)), sorted([name] for name in metric.reads))
