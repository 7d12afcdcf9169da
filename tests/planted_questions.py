"""Planted faults of density heads in protocol functions other than log_prob and sample, and in reading targets."""

from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.protocol import (
    QuadraticBound,
    estimate,
    exact_estimate,
    marginal,
    marginal_cdfs,
    normals,
    one_normal,
    peak_widths,
    pick,
    quadratic_bound,
    recentre,
)
from framework.target import Target
from plugins.density_head.gaussian.density import Gaussian
from plugins.density_head.von_mises.density import VonMises
from tests import planted_devices
from tests.planted_heads import CLASSES, HEIGHT, IMAGE, ONE, PLACE, Fault, Faulty
from tests.right_heads import LaplaceHead, Logistic, LogisticHead, Product, StudentTHead

POINT = Target("real", ("x", "y", "z"))


def first_row_only(density: Gaussian, index: Tensor) -> Distribution:
    """Return the picked items of the first row for every row."""
    return pick(Gaussian(*(part[:1].expand_as(part) for part in (density.location, density.scale))), index)


def changed_slope(density: Distribution, value: Tensor, pull: float, stiffness: float) -> QuadraticBound:
    found = quadratic_bound(density, value)
    assert found is not None
    return QuadraticBound(found.log_prob, pull * found.pull, stiffness * found.stiffness)


class NoJacobian(LaplaceHead):
    """Returns the log-density of the standardised value for a value in the target's unit."""

    def forward(self, raw: Tensor) -> Distribution:
        return Shifted(super().forward(raw), self.unit.log_volume)

    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        return -self(raw).log_prob(target)


class Shifted(Product):
    """Adds a constant to log_prob and subtracts it from the entropy."""

    def __init__(self, density: Distribution, by: float) -> None:
        assert isinstance(density, Product)
        self.by = by
        super().__init__(density.kind, *density.parameters)

    def log_prob(self, value: Tensor) -> Tensor:
        return super().log_prob(value) + self.by

    def entropy(self) -> Tensor:
        return super().entropy() - self.by


class LossOfTheStandardised(StudentTHead):
    """Computes the loss of the standardised target with the density in the target's unit."""

    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        return -self(raw).log_prob(self.unit.standardise(target))


class RootOfScale(LogisticHead):
    """Uses the root of the target's scale."""

    def parameters_of(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        place, scale = super().parameters_of(raw)
        return place, scale if self.unit.scale is None else scale / self.unit.scale.sqrt()


class NoLocation(LogisticHead):
    """Applies the target's scale but not its location."""

    def parameters_of(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        place, scale = super().parameters_of(raw)
        return place if self.unit.location is None else place - self.unit.location, scale


class FirstScale(LogisticHead):
    """Uses the first number's scale for all numbers."""

    def parameters_of(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        place, scale = super().parameters_of(raw)
        return place, scale if self.unit.scale is None else scale / self.unit.scale * self.unit.scale[0]


class StandardisedDraws(LogisticHead):
    """Returns samples in the standardised unit."""

    def forward(self, raw: Tensor) -> Logistic:
        return Standard(*self.parameters_of(raw), self.unit.standardise)


class Standard(Logistic):
    def __init__(self, place: Tensor, scale: Tensor, standardised: Any) -> None:
        self.standardised = standardised
        super().__init__(place, scale)

    def sample(self, sample_shape: Any = ()) -> Tensor:
        return self.standardised(super().sample(sample_shape))


class CalibratedTwice(LogisticHead):
    """Multiplies by the target's scale once more in `calibrate`."""

    @torch.no_grad()
    def calibrate(self, raw: Tensor, target: Tensor) -> None:
        super().calibrate(raw, target)
        if self.unit.scale is not None:
            self.factor.mul_(self.unit.scale[0])


class FirstHalf(LogisticHead):
    """Calibrates on the first half of the rows."""

    def calibrate(self, raw: Tensor, target: Tensor) -> None:
        super().calibrate(raw[: len(raw) // 2], target[: len(raw) // 2])


class NextRows(LogisticHead):
    """Calibrates with the target of each row assigned to the next row."""

    def calibrate(self, raw: Tensor, target: Tensor) -> None:
        super().calibrate(raw, target.roll(1, 0))


class Clipped(StudentTHead):
    """Clamps the loss to at most 20 nats."""

    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        return (-self(raw).log_prob(target)).clamp(max=20)


class PerNumber(LogisticHead):
    """Returns the loss divided by the number of target values."""

    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        return super().loss(raw, target) / target.shape[-1]


class Unread(LogisticHead):
    """Requires one raw parameter more than it reads."""

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        self.size += 1

    def parameters_of(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        place, scale = raw[..., :-1].chunk(2, -1)
        finite = raw[..., -1:].clamp(-1, 1) * 0
        scale = scale.clamp(-9, 9).exp() + finite
        return place.clamp(-1e6, 1e6), scale


class OneScaleForAll(LogisticHead):
    """Uses the first scale for all numbers, although each number has a raw parameter for its own scale."""

    def parameters_of(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        place, scale = super().parameters_of(raw)
        return place, scale[..., :1].expand_as(scale)


class LightTails(StudentTHead):
    """Returns a heavy-tailed log_prob that is 0.05 too large."""

    def forward(self, raw: Tensor) -> Distribution:
        return Shifted(super().forward(raw), 0.05)


class NarrowSlope(StudentTHead):
    """Returns a loss whose gradient in the location is a tenth too small where the scale is below 1e-3."""

    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        place, scale = self.parameters_of(raw)
        place = torch.where(scale < 1e-3, 0.9 * place + 0.1 * place.detach(), place)
        return -Product(torch.distributions.StudentT, torch.full_like(place, 2.5), place, scale).log_prob(
            target
        )


def reseeding(density: Distribution, shape: torch.Size) -> Tensor:
    torch.default_generator.manual_seed(0)
    return density.sample(shape)


def mixed_rows(head: Faulty, raw: Tensor) -> Distribution:
    """Return the density of raw parameters whose two batch dimensions are read in another order."""
    return head.sound(raw if raw.dim() < 3 else raw.transpose(0, 1).reshape(raw.shape))


def cut_batch(head: Faulty, raw: Tensor) -> Distribution:
    """Return the density of raw parameters whose rows beyond 256 are replaced by the first row."""
    if raw.dim() == 2 and len(raw) > 256:
        raw = torch.cat([raw[:256], raw[:1].expand(len(raw) - 256, -1)])
    return head.sound(raw)


def noisy(head: Faulty, raw: Tensor) -> Distribution:
    """Return the density of raw parameters with noise, as a dropout that is not turned off adds it."""
    return head.sound(raw + 0.01 * torch.randn_like(raw))


def in_place(head: Faulty, raw: Tensor) -> Distribution:
    """Return the density of raw parameters that are limited in place."""
    return head.sound(raw.clamp_(-0.1, 0.1))


class SortsTargets(LogisticHead):
    """Sorts the targets in place when it is calibrated."""

    def calibrate(self, raw: Tensor, target: Tensor) -> None:
        super().calibrate(raw, target)
        target.copy_(target.sort(0).values)


class CountsPredictions(LogisticHead):
    """Counts its predictions in a buffer."""

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        self.register_buffer("predictions", torch.zeros(()))

    def forward(self, raw: Tensor) -> Distribution:
        self.predictions += 1
        return super().forward(raw)


FURTHER_FAULTS = (
    *planted_devices.HEADS,
    # estimate
    Fault("estimate 0.05 nats high", ONE,
          {"estimate": lambda d, v: exact_estimate(d, v)._replace(log_mean=d.log_prob(v) + 0.05)}, "estimate"),
    Fault("estimate of a density that draws nothing has an error", HEIGHT,
          {"estimate": lambda d, v: exact_estimate(d, v)._replace(standard_error=0 * d.log_prob(v) + 0.1)}, "estimate"),
    Fault("estimate of classes is debiased by a tenth", CLASSES,
          {"estimate": lambda d, v: estimate(d, v)._replace(debiased=d.log_prob(v) + 0.1)}, "estimate"),
    Fault("estimate of the first value for all", HEIGHT,
          {"estimate": lambda d, v: exact_estimate(d, v[:1].expand_as(v))}, "estimate"),
    Fault("estimate without the second number", PLACE,
          {"estimate": lambda d, v: exact_estimate(marginal(d, 0), v[..., :1])}, "estimate"),
    # tempered
    Fault("power: σ T instead of σ √T", HEIGHT,
          {"tempered_density": lambda d, t: Gaussian(d.location, d.scale * t)}, "tempered: power"),
    Fault("power: κ T instead of κ / T", ONE,
          {"tempered_density": lambda d, t: VonMises(d.location, d.concentration * t)}, "tempered: power"),
    Fault("power: the density itself", HEIGHT, {"tempered_density": lambda d, t: d}, "tempered: power"),
    Fault("power about another place", HEIGHT,
          {"tempered_density": lambda d, t: Gaussian(d.location * t, d.scale * t.sqrt())}, "tempered: power"),
    Fault("power of the first number only", PLACE,
          {"tempered_density": lambda d, t: Gaussian(d.location, d.scale * torch.stack([t.sqrt(), t / t]))},
          "tempered: power"),
    # pick
    Fault("pick: the next item", HEIGHT, {"pick": lambda d, i: pick(d, 1 - i)}, "pick"),
    Fault("pick: the first item always", ONE, {"pick": lambda d, i: pick(d, 0 * i)}, "pick"),
    Fault("pick: items of the first row", HEIGHT, {"pick": first_row_only}, "pick"),
    Fault("pick: scales of the next item", HEIGHT,
          {"pick": lambda d, i: pick(Gaussian(d.location, d.scale.flip(-2)), i)}, "pick"),
    Fault("a mixture draws the other component", CLASSES, {"pick": lambda d, i: pick(d, 1 - i)},
          "mixture: samples follow log_prob"),
    # quadratic_bound, recentre, normals, mode_candidates and peak_widths
    Fault("slope: half the stiffness", HEIGHT,
          {"quadratic_bound": lambda d, v: changed_slope(d, v, 1, 0.5)}, "quadratic_bound"),
    Fault("slope: the pull pushes", ONE,
          {"quadratic_bound": lambda d, v: changed_slope(d, v, -1, 1)}, "quadratic_bound"),
    Fault("slope: of log_prob without the constant", HEIGHT,
          {"quadratic_bound":
           lambda d, v: quadratic_bound(d, v)._replace(log_prob=d.log_prob(v) + d.scale.log().sum(-1))},  # pyright: ignore
          "quadratic_bound"),
    Fault("about: adds the place", HEIGHT, {"recentre": lambda d, i, p: recentre(d, i, -p)}, "recentre"),
    Fault("about: forgets the place", ONE, {"recentre": lambda d, i, p: recentre(d, i, 0 * p)}, "recentre"),
    Fault("about: rows in order whatever the index", HEIGHT,
          {"recentre": lambda d, i, p: recentre(d, tuple(one.sort().values for one in i), p)}, "recentre"),
    Fault("normals: variances for deviations", HEIGHT,
          {"normals": lambda d: one_normal(d.location, d.scale.square())}, "normals"),
    Fault("normals: about 0", HEIGHT,
          {"normals": lambda d: normals(d)._replace(mean=0 * d.location.double())}, "normals"),  # pyright: ignore
    Fault("distance without the scales", PLACE,
          {"mahalanobis": lambda d, v: (v - d.location).square().sum(-1).double()}, "normals"),
    Fault("scales: logarithms", HEIGHT, {"peak_widths": lambda d: peak_widths(d).log() - 9},
          "mode candidates and peak widths"),
    Fault("peaks without the peak's dimension", HEIGHT, {"mode_candidates": lambda d: d.mode},
          "mode candidates and peak widths"),
    # of several numbers
    Fault("each_cdf at half the scale", IMAGE,
          {"marginal_cdfs": lambda d, v: marginal_cdfs(d, d.location + 2 * (v - d.location))}, "marginal_cdfs",
          {"scale": "number"}),
    Fault("mean of the first number for all", POINT, {"mean": lambda d: d.location[..., :1].expand_as(d.location)},
          "mean and variance"),
    Fault("variance of three numbers is the deviation", POINT, {"variance": lambda d: d.scale}, "mean and variance"),
    Fault("median with the numbers exchanged", PLACE, {"median": lambda d, n: d.location.flip(-1)}, "median"),
    Fault("marginals of three reals exchanged", POINT, {"marginal": lambda d, i: marginal(d, 2 - i)}, "marginals"),
    # targets with location and scale
    Fault("no Jacobian of the target's scale", HEIGHT, {}, "target's unit", head=NoJacobian),
    Fault("loss of the standardised target", HEIGHT, {}, "target's unit", head=LossOfTheStandardised),
    Fault("the root of the target's scale", HEIGHT, {}, "target's unit", head=RootOfScale),
    Fault("the target's location is forgotten", PLACE, {}, "target's unit", head=NoLocation),
    Fault("the first number's scale for all", PLACE, {}, "target's unit", head=FirstScale),
    Fault("draws in the standardised unit", HEIGHT, {}, "target's unit", head=StandardisedDraws),
    Fault("calibrated in the target's unit twice", HEIGHT, {}, "target's unit", head=CalibratedTwice),
    # rows, values, raw numbers
    Fault("calibrate reads the first half", HEIGHT, {}, "calibrate ignores the order of rows", head=FirstHalf),
    Fault("calibrate takes targets of the next row", HEIGHT, {}, "calibrate does not harm", head=NextRows),
    Fault("a loss of at most 20 nats", HEIGHT, {}, "loss is in nats", head=Clipped),
    Fault("a loss of one number, of two", PLACE, {}, "loss is in nats", head=PerNumber),
    Fault("a raw number is not read", HEIGHT, {}, "every raw parameter is read", head=Unread),
    Fault("two numbers share the first's scale", PLACE, {}, "every raw parameter is read", head=OneScaleForAll),
    Fault("log_prob of the first of several values", HEIGHT,
          {"log_prob": lambda d, v: d.log_prob(v[:1].expand_as(v) if v.dim() > 2 else v)}, "several values at once"),
    Fault("entropy is the batch's mean", HEIGHT,
          {"entropy": lambda d: d.entropy().mean() + 0 * d.entropy()}, "batch rows are independent"),
    Fault("rows beyond 256 are the first", ONE, {"forward": cut_batch}, "batch rows are independent"),
    Fault("a batch of two dimensions is transposed", HEIGHT, {"forward": mixed_rows}, "batch rows are independent"),
    Fault("draws seed the generator", HEIGHT, {"sample": reseeding}, "same seed, same bits"),
    Fault("noise on the raw parameters", HEIGHT, {"forward": noisy}, "no randomness in exact densities"),
    Fault("noise on a log_prob", CLASSES, {"log_prob": lambda d, v: d.log_prob(v) + 1e-6 * torch.rand(())},
          "no randomness in exact densities"),
    Fault("raw parameters are limited in place", HEIGHT, {"forward": in_place}, "no side effects"),
    Fault("log_prob subtracts from the targets", HEIGHT,
          {"log_prob": lambda d, v: d.log_prob(v.sub_(1).add(1))}, "no side effects"),
    Fault("loss subtracts from the targets", ONE,
          {"loss": lambda h, r, v: -h(r).log_prob(v.sub_(1).add(1))}, "no side effects"),
    Fault("calibrate sorts the targets", HEIGHT, {}, "no side effects", head=SortsTargets),
    Fault("a buffer counts predictions", HEIGHT, {}, "no side effects", head=CountsPredictions),
    # heavy tails
    Fault("a heavy tail that is 5 % too high", HEIGHT, {}, "integral", head=LightTails),
    Fault("a heavy tail's gradient is a tenth off where it is narrow", HEIGHT, {}, "loss gradient", head=NarrowSlope),
    Fault("a wide logistic has the deviation of a normal", HEIGHT,
          {}, "mean and variance", head=lambda target: Renamed(target)),
)  # fmt: skip


class Renamed(LogisticHead):
    """Returns densities with variance s² instead of π² s² / 3."""

    def forward(self, raw: Tensor) -> Logistic:
        return OfScale(*self.parameters_of(raw))


class OfScale(Logistic):
    @property
    def variance(self) -> Tensor:
        return self.width.square()
