"""Student's t densities of several independent real numbers."""

import math
from collections.abc import Callable
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from framework.distributions import protocol
from framework.distributions.exported import Exported, exported
from framework.distributions.symmetric import Symmetric
from framework.errors import UserError
from plugins.density_head.student_t.functions import (
    digamma_step,
    log_gamma_step,
    log_of_square_plus_one,
    tail_of_whole,
)

FEW = 64
"""Number of elements below which SciPy computes distribution functions.

For more elements, and whole degrees of freedom, a sum of terms takes a tenth of SciPy's time.
"""
MOST_TERMS = 40
"""Largest whole degrees of freedom for which the distribution function is computed as a sum."""
RARE = 1e-6
"""Probability below which SciPy computes a tail, since the sum of terms has lost its digits there."""
NORMAL = 1e8
"""Degrees of freedom that stand for a normal density: the log-densities differ by less than 1e-7 within 2 scales."""


class StudentT(Symmetric):
    """Independent densities of Student's t, one for each number.

    For a value y with the location m, the scale s, the degrees of freedom ν and z = (y - m)/s, log p = log Γ((ν + 1)/2)
    - log Γ(ν/2) - ½ log(π ν) - log s - (ν + 1)/2 · log(1 + z²/ν) (Student 1908; Johnson, Kotz & Balakrishnan 1995,
    §28.2). For large ν it is the normal density with the standard deviation s, and all functions stay exact up to
    ν = NORMAL and beyond.

    Args:
        location: m, (*batch, number).
        scale: s > 0, (*batch, number).
        freedom: ν > 2, broadcastable to `location`.
    """

    has_rsample = True

    def __init__(
        self,
        location: Float[Tensor, "*batch number"],
        scale: Float[Tensor, "*batch number"],
        freedom: Float[Tensor, "*any"],
    ) -> None:
        super().__init__(location)
        self.scale = scale
        self.freedom = freedom.to(location)

    @property
    def variance(self) -> Tensor:
        """Variance of each number, (*batch, number)."""
        return self.stddev.square()

    @property
    def stddev(self) -> Tensor:
        """Standard deviation of each number, (*batch, number)."""
        return self.scale * (self.freedom / (self.freedom - 2)).sqrt()

    @cached_property
    def _log_peak(self) -> Tensor:
        """Log-density at the location for the scale 1, in the shape of `freedom`."""
        return (log_gamma_step(self.freedom / 2) - math.log(2 * math.pi) / 2).to(self.location.dtype)

    def each_log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density of each number, nats, shaped like `value`."""
        ratio = (value - self.location) / self.scale / self.freedom.sqrt()
        return self._log_peak - self.scale.log() - (self.freedom + 1) / 2 * log_of_square_plus_one(ratio)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density, nats, (*sample, *batch)."""
        return self.each_log_prob(value).sum(-1)

    def rsample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        """Return samples, (*sample, *batch, *event), differentiable in location and scale."""
        shape = torch.Size(sample_shape) + self.location.shape
        noise = torch.randn(shape, dtype=self.location.dtype, device=self.location.device)
        half = (self.freedom / 2).expand(shape)
        shrunk = torch._standard_gamma(half) / half  # a χ² draw, divided by its mean ν
        return self.location + self.scale * noise / shrunk.clamp(min=torch.finfo(noise.dtype).tiny).sqrt()

    def entropy(self) -> Tensor:
        """Return the entropy, nats, (*batch)."""
        freedom = self.freedom.double()
        standard = (freedom + 1) / 2 * digamma_step(freedom / 2) - self._log_peak.double()
        return (self.scale.log() + standard.to(self.scale.dtype)).sum(-1)

    def cdf(self, value: Tensor) -> Tensor:
        """Return P(X_i ≤ y_i) of each number, float64, shaped like `value`."""
        standard = (value.double() - self.location.double()) / self.scale
        freedom = self.freedom.flatten()[:1].double() if self.freedom.numel() else self.freedom
        if standard.numel() < FEW or not bool((self.freedom == freedom).all() & (freedom % 1 == 0)):
            return _apply_scipy("stdtr", self.freedom, standard)
        whole = int(freedom)
        if whole > MOST_TERMS:
            return _apply_scipy("stdtr", self.freedom, standard)
        beyond = tail_of_whole(standard, whole)
        rare = beyond < RARE  # a difference from ½ has lost its digits there
        if bool(rare.any()):
            beyond[rare] = _apply_scipy("stdtr", freedom, -standard[rare].abs())
        return torch.where(standard < 0, beyond, 1 - beyond)

    def icdf(self, probability: Tensor) -> Tensor:
        """Return the quantile of each number, float64, for a probability that broadcasts to (*batch, number)."""
        lower = torch.minimum(probability, 1 - probability)
        distance = self.scale.double() * _apply_scipy("stdtrit", self.freedom, lower)
        return self.location.double() + torch.where(probability < 0.5, distance, -distance)

    def half_width(self, mass: float) -> Tensor:
        """Return half the width of the interval around `location` with probability `mass`, float64."""
        tail = torch.full_like(self.location, (1 - mass) / 2, dtype=torch.float64)
        return -self.scale.double() * _apply_scipy("stdtrit", self.freedom, tail)


def _apply_scipy(name: str, freedom: Tensor, argument: Tensor) -> Tensor:
    """Return the value of the function `name` of `scipy.special` at the arguments ν and `argument`, float64.

    ν are the degrees of freedom in `freedom`. Torch lacks these functions. The result has no gradient.
    """
    # imported here, since importing SciPy is slow and most commands do not need it
    from scipy import special

    with torch.no_grad():
        pair = (part.detach().double().cpu().numpy() for part in torch.broadcast_tensors(freedom, argument))
        return torch.from_numpy(np.asarray(getattr(special, name)(*pair))).to(argument.device)


protocol.estimate.register(StudentT, protocol.exact_estimate)


def _change_parameters(density: StudentT, change: Callable[[Tensor], Tensor]) -> StudentT:
    parts = (density.location, density.scale, density.freedom.expand_as(density.location))
    return StudentT(*map(change, parts))


@protocol.marginal.register
def _(density: StudentT, index: int) -> StudentT:
    return _change_parameters(density, lambda part: part[..., index : index + 1])


@protocol.pick.register
def _(density: StudentT, index: Tensor) -> StudentT:
    return _change_parameters(density, lambda part: protocol.take(part, index))


@protocol.marginal_cdfs.register
def _(density: StudentT, value: Tensor) -> Tensor:
    return density.cdf(value)


@protocol.cdf.register
def _(density: StudentT, value: Tensor) -> Tensor:
    return density.cdf(value).squeeze(-1)


@protocol.ranked_score.register
def _(density: StudentT, value: Tensor) -> Tensor:
    """Return the continuous ranked probability score by its formula (Jordan, Krüger & Lerch 2019, appendix A.2)."""
    freedom, scale = density.freedom.double(), density.scale.double()
    away = (value.double() - density.location.double()) / scale
    ratio = away / freedom.sqrt()
    # both sides of the location are equal: |z| keeps the digits of the lower tail
    inner = (1 - 2 * _apply_scipy("stdtr", freedom, -away.abs())) * away.abs()
    # 2 f(z) (ν + z²)/(ν - 1), with f(z) (1 + z²/ν) computed as a power, so that no square overflows
    log_bell = log_gamma_step(freedom / 2) - (freedom - 1) / 2 * log_of_square_plus_one(ratio)
    bell = 2 * log_bell.exp() * freedom / (freedom - 1) / math.sqrt(2 * math.pi)
    # √ν B(½, ν - ½)/B(½, ν/2)², with the beta functions written by `log_gamma_step`
    log_spread = 2 * log_gamma_step(freedom / 2) - log_gamma_step(freedom - 0.5)
    spread = (
        log_spread.exp() * freedom * (freedom / (freedom - 0.5)).sqrt() / (freedom - 1) / math.sqrt(math.pi)
    )
    return (scale * (inner + bell - spread)).clamp(min=0).squeeze(-1)


@protocol.quadratic_bound.register
def _(density: StudentT, value: Tensor) -> protocol.QuadraticBound:
    # -log(1 + u) is a convex function of u = z²/ν, so that its tangent is a lower bound, which is quadratic in z
    residual = value - density.location
    ratio = residual / density.scale / density.freedom.sqrt()
    share = torch.exp(-log_of_square_plus_one(ratio))
    stiffness = (density.freedom + 1) / density.freedom * share / density.scale.square()
    return protocol.QuadraticBound(density.log_prob(value), -residual * stiffness, stiffness)


@protocol.recentre.register
def _(density: StudentT, index: tuple[Tensor, ...], origin: Tensor) -> StudentT:
    whole = _change_parameters(density, lambda part: part.double()[index])
    location = whole.location - origin
    return StudentT(location, whole.scale.expand_as(location), whole.freedom.expand_as(location))


@protocol.tempered_density.register
def _(density: StudentT, temperature: Tensor) -> StudentT:
    """Return the power p^(1/T), a density of Student's t with ν' = (ν + 1)/T - 1 and the scale s √(ν/ν').

    Raises:
        UserError: T is so large that ν' ≤ 2, where the power has no variance.
    """
    freedom = (density.freedom + 1) / temperature - 1
    if not torch.compiler.is_exporting() and not bool((freedom > 2).all()):
        raise UserError(
            f"A density of Student's t with {float(density.freedom.min()):.3g} degrees of freedom cannot have the "
            f"temperature {float(temperature):.3g}, because it has a variance only at temperatures below "
            f"{float((density.freedom.min() + 1) / 3):.3g}. Leave the temperature out: this head calibrates its scale "
            "and degrees of freedom itself."
        )
    scale = density.scale * (density.freedom / freedom).sqrt()
    return StudentT(density.location, scale.to(density.scale.dtype), freedom)


@exported.register
def _(density: StudentT) -> Exported:
    code = "plugins.density_head.student_t.numpy_student_t"
    freedom = density.freedom.expand_as(density.location)
    parameters = {"location": density.location, "scale": density.scale, "freedom": freedom}
    return Exported("student_t", parameters, code=code)
