"""Correct density heads like those of other authors; `mode=check` must refuse none of them."""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import ClassVar

import torch
from torch import Tensor
from torch.distributions import Distribution, Laplace, StudentT, constraints

from framework.density_head import DensityHead
from framework.distributions.circular import circular, wrap
from framework.distributions.protocol import (
    arc_length,
    arc_probability,
    cdf,
    estimate,
    exact_estimate,
    marginal,
    marginal_cdfs,
    median,
    pick,
    take,
)
from framework.heads.parameters import require_finite
from framework.heads.unit import Unit
from framework.target import Target
from framework.testing.densities import examine_densities
from framework.testing.finding import Finding
from framework.testing.head_subject import HeadSubject
from framework.testing.heads import examine_head
from framework.testing.rows import HeadRow

LARGEST = 1e6
"""Bound on the magnitude of locations."""
SCALES = 9.0
"""Bound on the magnitude of logarithms of scales."""


class _OfReals(DensityHead):
    """Base of heads with a location and a scale for each number, in the target's unit."""

    bibtex = ""

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("real", by=type(self).__name__)
        self.unit = Unit.of(target)
        self.size = 2 * len(target.names)

    def parameters_of(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        place, scale = require_finite(raw, self.size).chunk(2, -1)
        place, scale = place.clamp(-LARGEST, LARGEST), scale.clamp(-SCALES, SCALES).exp()
        place, scale, _ = self.unit.to_target_unit(place, scale)
        return place, scale


class Product(Distribution):
    """Product of independent one-dimensional torch densities.

    Unlike torch's `Independent` it also accepts an empty batch. Only the required protocol functions are registered.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    @property
    def support(self) -> constraints.Constraint:
        return constraints.real_vector

    def __init__(self, kind: Callable[..., Distribution], *parameters: Tensor) -> None:
        self.kind, self.parameters = kind, parameters
        self.each = kind(*parameters, validate_args=False)
        shape = torch.Size(self.each.batch_shape)
        super().__init__(torch.Size(shape[:-1]), torch.Size(shape[-1:]), validate_args=False)

    @property
    def mode(self) -> Tensor:
        return self.each.mode

    @property
    def mean(self) -> Tensor:
        return self.each.mean

    @property
    def variance(self) -> Tensor:
        return self.each.variance

    def log_prob(self, value: Tensor) -> Tensor:
        return self.each.log_prob(value).sum(-1)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        return self.each.sample(torch.Size(sample_shape))

    def entropy(self) -> Tensor:
        return self.each.entropy().sum(-1)


estimate.register(Product, exact_estimate)


@marginal.register
def _(density: Product, index: int) -> Product:
    return Product(density.kind, *(one[..., index : index + 1] for one in density.parameters))


class StudentTHead(_OfReals):
    """Student's t with 2.5 degrees of freedom, which has heavy tails and an infinite fourth moment."""

    freedom = 2.5

    def forward(self, raw: Tensor) -> Distribution:
        place, scale = self.parameters_of(raw)
        return Product(StudentT, torch.full_like(place, self.freedom), place, scale)


class CauchyHead(StudentTHead):
    """Student's t with one degree of freedom, which has neither mean nor variance."""

    freedom = 1.0


class LearnedTHead(DensityHead):
    """Student's t whose degrees of freedom are predicted, written from the docstring of the base class alone.

    The head does not use the target's location and scale.
    """

    bibtex = ""

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("real", by="LearnedTHead")
        self.size = 3 * len(target.names)

    def forward(self, raw: Tensor) -> Distribution:
        place, scale, freedom = require_finite(raw, self.size).chunk(3, -1)
        place, scale = place.clamp(-LARGEST, LARGEST), scale.clamp(-SCALES, SCALES).exp()
        return Product(StudentT, 1 + 30 * torch.sigmoid(freedom), place, scale)


class LaplaceHead(_OfReals):
    """Laplace densities of torch."""

    def forward(self, raw: Tensor) -> Distribution:
        return Product(Laplace, *self.parameters_of(raw))


class _Located(Distribution):
    """Base of independent densities with a location and a width, symmetric about the location."""

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    def __init__(self, place: Tensor, scale: Tensor) -> None:
        self.place, self.width = place, scale
        super().__init__(place.shape[:-1], place.shape[-1:], validate_args=False)

    @property
    def mean(self) -> Tensor:
        return self.place

    @property
    def mode(self) -> Tensor:
        return self.place


@marginal.register
def _(density: _Located, index: int) -> _Located:
    return type(density)(density.place[..., index : index + 1], density.width[..., index : index + 1])


@median.register
def _(density: _Located, samples: int) -> Tensor:
    return density.place


@pick.register
def _(density: _Located, index: Tensor) -> _Located:
    return type(density)(take(density.place, index), take(density.width, index))


class Logistic(_Located):
    """Independent logistic densities e^-z / (s (1 + e^-z)²), with all results that have a closed form."""

    @property
    def support(self) -> constraints.Constraint:
        return constraints.real_vector

    @property
    def variance(self) -> Tensor:
        return (math.pi * self.width).square() / 3

    def log_prob(self, value: Tensor) -> Tensor:
        size = ((value - self.place) / self.width).abs()
        return (-size - 2 * torch.log1p((-size).exp()) - self.width.log()).sum(-1)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape) + self.place.shape
        drawn = torch.rand(shape, dtype=self.place.dtype, device=self.place.device)
        drawn = drawn.clamp(min=torch.finfo(self.place.dtype).tiny)
        return self.place + self.width * torch.logit(drawn, eps=torch.finfo(self.place.dtype).eps / 2)

    def entropy(self) -> Tensor:
        return (self.width.log() + 2).sum(-1)


estimate.register(Logistic, exact_estimate)


@marginal_cdfs.register
def _(density: Logistic, value: Tensor) -> Tensor:
    return torch.sigmoid((value.double() - density.place.double()) / density.width.double())


@cdf.register
def _(density: Logistic, value: Tensor) -> Tensor:
    return torch.sigmoid((value.double() - density.place.double()) / density.width.double())[..., 0]


class LogisticHead(_OfReals):
    """Logistic densities, with one factor of all scales that is fitted to the validation split."""

    factor: Tensor

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        self.register_buffer("factor", torch.ones((), dtype=torch.float64))

    def forward(self, raw: Tensor) -> Logistic:
        place, scale = self.parameters_of(raw)
        return Logistic(place, scale * self.factor.to(scale))

    @torch.no_grad()
    def calibrate(self, raw: Tensor, target: Tensor) -> None:
        place, scale = self.parameters_of(raw)
        factors = self.factor * torch.logspace(
            -1, 1, 41, dtype=torch.float64, device=raw.device
        )  # 1 among them
        found = [Logistic(place, scale * one).log_prob(target).double().mean() for one in factors]
        self.factor.copy_(factors[int(torch.stack(found).argmax())])


class LogNormal(Distribution):
    """Density of exp(z) for a normal number z, which is 0 for negative numbers."""

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    @property
    def support(self) -> constraints.Constraint:
        return constraints.independent(constraints.positive, 1)

    def __init__(self, place: Tensor, width: Tensor) -> None:
        self.place, self.width = place, width
        super().__init__(place.shape[:-1], place.shape[-1:], validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        possible = value > 0
        log_value = torch.where(possible, value, 1.0).log()
        size = -((log_value - self.place) / self.width).square() / 2 - log_value
        log_prob = size - self.width.log() - math.log(2 * math.pi) / 2
        return torch.where(possible, log_prob, -math.inf).sum(-1)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        with torch.no_grad():
            noise = torch.randn(
                *sample_shape, *self.place.shape, dtype=self.place.dtype, device=self.place.device
            )
            return (self.place + self.width * noise).exp()

    def entropy(self) -> Tensor:
        return (self.place + self.width.log() + (1 + math.log(2 * math.pi)) / 2).sum(-1)

    @property
    def mode(self) -> Tensor:
        return (self.place - self.width.square()).exp()

    @property
    def mean(self) -> Tensor:
        return (self.place + self.width.square() / 2).exp()

    @property
    def variance(self) -> Tensor:
        return torch.expm1(self.width.square()) * (2 * self.place + self.width.square()).exp()


estimate.register(LogNormal, exact_estimate)


@marginal.register
def _(density: LogNormal, index: int) -> LogNormal:
    return LogNormal(density.place[..., index : index + 1], density.width[..., index : index + 1])


class LogNormalHead(DensityHead):
    """Log-normal densities of positive numbers."""

    bibtex = ""

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("real", by="LogNormalHead")
        self.size = 2 * len(target.names)

    def forward(self, raw: Tensor) -> LogNormal:
        place, width = require_finite(raw, self.size).chunk(2, -1)
        return LogNormal(place.clamp(-20, 20), width.clamp(-5, 1).exp())


class WrappedNormal(_Located):
    """Σ_k N(φ + 2πk; μ, σ²) for each angle (Mardia & Jupp 2000, §3.5.7), σ ≤ 2."""

    @property
    def support(self) -> constraints.Constraint:
        return circular

    turns = 2 * math.pi * torch.arange(-3, 4, dtype=torch.float64)

    def each(self, value: Tensor) -> Tensor:
        standard = (wrap(value - self.place).unsqueeze(-1) + self.turns.to(value)) / self.width.unsqueeze(-1)
        return torch.logsumexp(-standard.square() / 2, -1) - self.width.log() - math.log(2 * math.pi) / 2

    def log_prob(self, value: Tensor) -> Tensor:
        return self.each(value).sum(-1)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape) + self.place.shape
        noise = torch.randn(shape, dtype=self.place.dtype, device=self.place.device)
        return wrap(self.place + self.width * noise)

    def entropy(self) -> Tensor:
        # a narrow density has the entropy of a normal one; for wider ones the trapezium rule is accurate
        angle = torch.linspace(-math.pi, math.pi, 801, dtype=torch.float64)[:-1].to(self.place)
        angle = angle.reshape(-1, *(1,) * self.place.dim())
        centred = WrappedNormal(torch.zeros_like(self.place), self.width.clamp(min=0.05))
        log_prob = centred.each(angle)
        wide = -(log_prob.exp() * log_prob).sum(0) * 2 * math.pi / 800
        normal = self.width.log() + (1 + math.log(2 * math.pi)) / 2
        return torch.where(self.width < 0.1, normal, wide).sum(-1)


estimate.register(WrappedNormal, exact_estimate)


@arc_probability.register
def _(density: WrappedNormal, start: Tensor, end: Tensor) -> Tensor:
    first = wrap(start.double() - density.place.double())

    def below(value: Tensor) -> Tensor:
        turned = value + density.turns
        return torch.special.ndtr(turned / density.width.double()).sum(-1)

    return (below(first + arc_length(start, end)) - below(first)).clamp(0, 1)


class WrappedNormalHead(DensityHead):
    """Wrapped normal densities with a location and a width for each angle."""

    bibtex = ""

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("angle", by="WrappedNormalHead")
        self.angles = len(target.names)
        self.size = 3 * self.angles

    def forward(self, raw: Tensor) -> WrappedNormal:
        cos, sin, width = require_finite(raw, self.size).chunk(3, -1)
        # the bounds keep squares in the gradient of atan2 from overflow and underflow
        place = torch.atan2(sin.clamp(-1e18, 1e18), cos.clamp(-1e18, 1e18) + 1e-12)
        return WrappedNormal(place, 1e-3 + 1.9 * torch.sigmoid(width))


HEADS: Mapping[str, tuple[type[DensityHead], tuple[Target, ...]]] = {
    "Student's t": (StudentTHead, (Target("real", ("height",)), Target("real", ("x", "y")))),
    "Cauchy": (CauchyHead, (Target("real", ("height",)), Target("real", ("x", "y")))),
    "Student's t, freedom predicted": (
        LearnedTHead,
        (Target("real", ("height",)), Target("real", ("x", "y"))),
    ),
    "Laplace": (LaplaceHead, (Target("real", ("height",)), Target("real", ("x", "y")))),
    "logistic": (LogisticHead, (Target("real", ("height",)), Target("real", ("x", "y")))),
    "log-normal": (LogNormalHead, (Target("real", ("height",)), Target("real", ("x", "y")))),
    "wrapped normal": (
        WrappedNormalHead,
        (Target("angle", ("azimuth",)), Target("angle", ("azimuth", "tilt"))),
    ),
}
POSITIVE = ("log-normal",)
"""Names of the heads whose density is 0 for negative numbers."""


def right_findings(name: str, target: Target) -> Iterator[Finding]:
    """Yield all findings of the head with this name."""
    kind = HEADS[name][0]

    def positive(count: int) -> Tensor:
        generator = torch.Generator().manual_seed(0)
        return torch.randn(count, len(target.names), generator=generator).exp()

    row = HeadRow(name, target, values=positive if name in POSITIVE else None)
    subject = HeadSubject(row, lambda: kind(target), build_for=kind)
    yield from examine_head(subject)
    yield from examine_densities(subject)
