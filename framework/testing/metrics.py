"""The contract of a metric: one function a property, each reporting the worst case it saw."""

import copy
import math
from collections.abc import Callable, Collection, Iterator
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
from framework.distributions.protocol import estimate, exactly, marginal, median, pick, take
from framework.metric import Metric
from framework.prediction import Prediction, Split
from framework.target import Target
from framework.testing.balls import Ball, ball
from framework.testing.finding import SEED, Finding, Worst, examined
from framework.testing.heads import values
from framework.testing.rows import MetricRow

Make = Callable[[], Metric]
SAMPLES = 24


class Cardioid(Distribution):
    """(1 + 2ρ cos(φ - μ)) / 2π for each angle (Mardia & Jupp 2000, §3.5.5): the simplest density on the circle.

    Args:
        location: μ, (*batch, angle), radians.
        strength: 2ρ in (0, 1], (*batch); 1 everywhere by default, the narrowest.
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
        # 1 + cos d = 2 cos²(d/2); kept off its zero, where no metric could compare anything
        near = 2 * torch.cos((value - self.location) / 2).square()
        weight = self.strength.unsqueeze(-1)
        near = 1 - weight + weight * near
        return (near.clamp(min=1e-12).log() - math.log(2 * math.pi)).sum(-1)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape) + self.batch_shape + self.event_shape
        # with t = tan(θ/2) the density of strength 1 is ∝ 1/(1+t²)²: √3 t is Student's with 3 degrees of freedom
        normal = torch.randn(4, *shape, dtype=self.location.dtype)
        found = self.location + 2 * torch.atan(normal[0] / normal[1:].norm(dim=0))
        if (self.strength == 1).all():
            return found
        # 1 + s cos d = s (1 + cos d) + (1 - s): that density, or else the uniform one
        anywhere = 2 * math.pi * torch.rand(shape, dtype=self.location.dtype)
        return torch.where(torch.rand(shape) < self.strength.unsqueeze(-1), found, anywhere)

    def entropy(self) -> Tensor:
        # log 2π - (1/2π) ∫ (1 + s cos d) log(1 + s cos d) = log 4π - 1 + r - log(1 + r) with r = √(1 - s²)
        root = (1 - self.strength.square()).sqrt()
        return self.event_shape[0] * (math.log(4 * math.pi) - 1 + root - torch.log1p(root))


estimate.register(Cardioid, exactly)


@marginal.register
def _(density: Cardioid, index: int) -> Cardioid:
    return Cardioid(density.location[..., index : index + 1], density.strength)


@median.register
def _(density: Cardioid, samples: int) -> Tensor:
    return density.location


@pick.register
def _(density: Cardioid, index: Tensor) -> Cardioid:
    return Cardioid(take(density.location, index))


def numbers_about(target: Target) -> int:
    """How many numbers `density_about` reads."""
    return len(target.names) if target.kind == "class" else math.prod(target.event_shape)


def density_about(target: Target, place: Tensor, breadth: Tensor | None = None) -> Distribution:
    """The simplest density of the target's kind about a place (*batch, number); for classes their logits.

    Args:
        breadth: 1 or more, (*batch): how many times as broad; classes as much less sure.
    """
    if target.kind == "angle":
        return Cardioid(place, None if breadth is None else 1 / breadth)
    if target.kind == "image":
        image = place.unflatten(-1, target.event_shape)
        wide = torch.ones_like(image) if breadth is None else breadth[..., None, None, None].expand_as(image)
        return Independent(Normal(image, wide.to(image), validate_args=False), 3, validate_args=False)
    if target.kind == "real":
        # MultivariateNormal, since Independent refuses empty batches
        scale = torch.eye(place.shape[-1], dtype=place.dtype)
        if breadth is not None:
            scale = scale * breadth[..., None, None].to(place)
        return MultivariateNormal(place, scale_tril=scale, validate_args=False)
    return Categorical(
        logits=place if breadth is None else place / breadth.unsqueeze(-1), validate_args=False
    )


def examine_metric(row: MetricRow, build: Make) -> Iterator[Finding]:
    """Every property of one metric on predictions of `row.target`."""
    reads = build().reads
    whole = _predictions(row, SAMPLES, reads)
    checks: dict[str, tuple[float, Callable[[Worst], None]]] = {
        "named numbers": (0.0, lambda worst: _named(build, whole, worst)),
        "nothing seen is NaN": (0.0, lambda worst: _nothing(build, whole, worst)),
        "batches do not matter": (1e-9, lambda worst: _batches(build, whole, worst)),
        "order does not matter": (1e-9, lambda worst: _order(build, whole, worst)),
        "states merge": (1e-9, lambda worst: _merge(build, whole, worst)),
        "reset and copy": (0.0, lambda worst: _reset(build, whole, worst)),
        "perfect beats random": (0.0, lambda worst: _perfect(build, row, worst)),
        "only the images it names": (0.0, lambda worst: _images(build, whole, worst)),
    }
    if not reads:
        del checks["only the images it names"]
    for name, (limit, check) in checks.items():
        if name not in row.leave_out:
            yield examined(name, row.limits.get(name, limit), check)


Slices = Callable[[Tensor, Split], Prediction]


def _predictions(row: MetricRow, count: int, reads: Collection[str]) -> Slices:
    """Indices and split → the prediction of those samples of one fixed set; as outliers they have other densities, most
    of them broader. Where images are read, they show balls."""
    target = values(row.target, (count,))
    fields = {name: make(count) for name, make in row.fields.items()}
    if reads:
        fields = {**ball(_place(row, target), row.size), **fields}
    generator = torch.Generator().manual_seed(SEED)
    location = (
        torch.randn(target.flatten(1).shape, generator=generator)
        if row.target.kind != "class"
        else torch.zeros(())
    )
    logits = torch.randn(count, len(row.target.names), generator=generator)
    breadth = 1 + 2 * torch.rand(count, generator=generator)

    def some(index: Tensor, split: Split) -> Prediction:
        if split == "outliers":
            # the densities of others, so that no two of one index are about the same place
            other = (index + 1) % count
            about = logits[other] if row.target.kind == "class" else location[other]
            density = density_about(row.target, about, breadth[index])
        else:
            about = logits[index] if row.target.kind == "class" else location[index]
            density = density_about(row.target, about)
        if reads:
            density = Ball(density, about, row.size)
        batch = {"target": target[index], "index": index, "group": torch.zeros_like(index)}
        batch |= {name: field[index] for name, field in fields.items()}
        return Prediction(density, batch, split=split)

    return some


def _place(row: MetricRow, target: Tensor) -> Tensor:
    """What `density_about` reads for a density about the target: of classes logits."""
    return (
        3.0 * torch.nn.functional.one_hot(target, len(row.target.names))
        if row.target.kind == "class"
        else target.flatten(1)
    )


def _feed(metric: Metric, some: Slices, part: Tensor) -> None:
    """These samples of every split that the metric reads."""
    for split in metric.splits:
        metric.update(some(part, split))


def _after(build: Make, some: Slices, parts: list[Tensor]) -> dict[str, Tensor]:
    metric = build()
    torch.manual_seed(SEED)
    for part in parts:
        _feed(metric, some, part)
    return metric.compute()


def _compare(what: str, found: dict[str, Tensor], wanted: dict[str, Tensor], worst: Worst) -> None:
    worst.same(f"{what}: keys", sorted(found), sorted(wanted))
    for key, value in wanted.items():
        gap = (found[key].double() - value.double()).abs() / value.double().abs().clamp(min=1)
        both = found[key].isnan() & value.isnan()
        worst.see(gap.where(~both, 0), f"{what}: {key} {found[key].item():.9g}, wanted {value.item():.9g}")


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


def _quiet(build: Make, some: Slices, parts: list[Tensor]) -> dict[str, Tensor]:
    import warnings

    with warnings.catch_warnings():
        # torchmetrics warns of compute before update, which is what is tried here
        warnings.filterwarnings("ignore", message=".*compute.*before the.*update.*", category=UserWarning)
        return _after(build, some, parts)


def _batches(build: Make, some: Slices, worst: Worst) -> None:
    index = torch.arange(SAMPLES)
    wanted = _after(build, some, [index])
    _compare("in batches of 7", _after(build, some, list(index.split(7))), wanted, worst)
    _compare("one by one", _after(build, some, list(index.split(1))), wanted, worst)


def _order(build: Make, some: Slices, worst: Worst) -> None:
    index = torch.arange(SAMPLES)
    _compare("backwards", _after(build, some, [index.flip(0)]), _after(build, some, [index]), worst)


def _merge(build: Make, some: Slices, worst: Worst) -> None:
    """What two processes saw, merged as torchmetrics merges them."""
    first, second = build(), build()
    _feed(first, some, torch.arange(10))
    _feed(second, some, torch.arange(10, SAMPLES))
    first.merge_state(second)
    _compare("two halves merged", first.compute(), _after(build, some, [torch.arange(SAMPLES)]), worst)


def _reset(build: Make, some: Slices, worst: Worst) -> None:
    index = torch.arange(SAMPLES)
    metric = build()
    _feed(metric, some, index[:5])
    metric.reset()
    _feed(metric, some, index)
    wanted = _after(build, some, [index])
    _compare("after a reset", metric.compute(), wanted, worst)
    _compare("of a copy", copy.deepcopy(metric).compute(), wanted, worst)


def _perfect(build: Make, row: MetricRow, worst: Worst) -> None:
    """A density about the target is judged better, in every column that has a better way, than one about elsewhere.

    A metric that reads outliers sees them broader beside the former, and as narrow as the test samples beside the
    latter.
    """
    metric = build()
    some = _predictions(row, SAMPLES, metric.reads)
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


def _images(build: Make, some: Slices, worst: Worst) -> None:
    """Each asked for alone, since the prediction was not told: those that `reads` names, each once."""
    metric, prediction = build(), some(torch.arange(SAMPLES), build().splits[0])
    metric.update(prediction)
    asked = prediction.density.asked  # type: ignore[attr-defined]  # a Ball
    worst.same("images drawn", sorted(map(sorted, asked)), sorted([name] for name in metric.reads))
