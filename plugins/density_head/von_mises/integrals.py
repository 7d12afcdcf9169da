"""Integrals of the von Mises density: divergence, distribution function, arcs that hold a given probability.

All are sums of positive terms by Gauss-Legendre quadrature, so that small results keep their digits too.
"""

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from plugins.density_head.von_mises.angles import half_angle
from plugins.density_head.von_mises.bessel import deviation_of, height_and_deviation, log_height, polynomial
from plugins.density_head.von_mises.blocks import in_blocks
from plugins.density_head.von_mises.coefficients import NODES
from plugins.density_head.von_mises.functions import fall, mean_resultant, mean_resultant_slope

ROUNDS = 64
"""Largest number of rounds of the inversion in `half_width`; bisection alone needs 53 to reach the last digit."""

AT_ONCE = 2**13
"""Number of integrand values that are computed at once, which fit into the processor's cache."""
CUT = 40.0
"""Integrals end where the density has fallen to exp(-CUT) of its value at the start; the rest is below rounding."""


def kl_divergence(
    first_mean: Tensor, first_concentration: Tensor, second_mean: Tensor, second_concentration: Tensor
) -> Tensor:
    """Return the Kullback-Leibler divergence of the second density from the first, ∫ p₁ log(p₁/p₂), nats.

    It is A(κ₁) κ₂ (1 - cos(μ₁-μ₂)) + ∫_{κ₁}^{κ₂} (κ₂-x) A'(x) dx. Neither term is negative. log I0 has the derivative
    A, so that the integral is log I0(κ₂) - log I0(κ₁) - A(κ₁)(κ₂-κ₁). The divergence is exactly 0 for equal densities
    and accurate for nearly equal ones. It is differentiable like `log_prob`.
    """
    turned = -fall(first_mean, second_mean, mean_resultant(first_concentration) * second_concentration)
    return turned + _Bregman.apply(*torch.broadcast_tensors(first_concentration, second_concentration))


def cdf(value: Tensor, mean: Tensor, concentration: Tensor) -> Tensor:
    """Return the probability of the arc from mean - π to `value`; each further full rotation of `value` adds 1.

    The convention is SciPy's. Quadrature in float64 has an absolute error below 1e-15. A probability P in the lower
    tail has a relative error below 4e-15 · max(1, |log P|). The result is differentiable, once, in all three arguments.
    """
    dtype = torch.promote_types(torch.promote_types(value.dtype, mean.dtype), concentration.dtype)
    wide = (argument.double() for argument in (value, mean, concentration))
    return _Cdf.apply(*torch.broadcast_tensors(*wide)).to(dtype)


@torch.no_grad()
def half_width(mass: Tensor, concentration: Tensor) -> Tensor:
    """Return half the width, radians in [0, π], of the shortest arc with the probability `mass`, centred on the mean.

    Newton's method solves an equation for the probability inside the arc or, for a mass above one half, for the
    logarithm of the probability outside. If a Newton step leaves the bracket of the solution, the bracket is halved
    instead. There are at most ROUNDS rounds. The half width has no gradient.

    Raises:
        ValueError: a mass outside [0, 1].
    """
    if not bool(((mass >= 0) & (mass <= 1)).all()):
        raise ValueError(
            f"The probability of an arc must lie between 0 and 1, got values from {mass.min().item()} to "
            f"{mass.max().item()}."
        )
    dtype = torch.promote_types(mass.dtype, concentration.dtype)
    mass, kappa = torch.broadcast_tensors(mass.double(), concentration.double())
    inside = mass <= 0.5
    target = torch.where(inside, mass, 1 - mass) / 2  # of one side
    low, high = torch.zeros_like(mass), torch.full_like(mass, math.pi)
    # starting value: the normal density of z = 2√κ sin(θ/2), or the uniform one if that is wider than the circle
    normal = torch.special.ndtri((1 + mass) / 2).clamp(max=38) / (2 * kappa.sqrt())
    width = torch.minimum(2 * torch.asin(normal.clamp(max=1)), math.pi * (1 + 3 * kappa) * mass).nan_to_num()
    finished = (mass == 0) | (mass == 1)
    width = torch.where(finished, math.pi * mass, width.clamp(max=3.1))
    constants, peak = height_and_deviation(kappa), log_height(kappa)
    for _ in range(ROUNDS):
        if bool(finished.all()):
            break
        sine, cosine = torch.sin(width / 2), torch.cos(width / 2)
        mass_of_side, _ = _one_side(sine, cosine, kappa, inside, constants)
        slope = torch.exp(peak - 2 * (kappa * sine) * sine)
        too_wide = (mass_of_side > target) == inside
        low, high = torch.where(too_wide, low, width), torch.where(too_wide, width, high)
        straight = (target - mass_of_side) / torch.where(inside, slope, -slope)
        following = width + torch.where(
            inside, straight, mass_of_side * torch.log(mass_of_side / target) / slope
        )
        # near π the mass outside falls linearly, not exponentially
        following = torch.where((following > low) & (following < high), following, width + straight)
        following = torch.where((following > low) & (following < high), following, (low + high) / 2)
        # this close, the error after a step is the square of the step
        near = 1e-10 * torch.minimum(width, math.pi - width) + 4e-16 * width
        settled = (straight.abs() <= near) | (high - low <= 4e-16 * high)
        following = torch.where(settled, (width + straight).clamp(0, math.pi), following)
        width = torch.where(finished, width, following)
        finished = finished | settled
    return width.to(dtype)


@torch.no_grad()
def mass_above(value: Tensor, mean: Tensor, concentration: Tensor, equal: float) -> tuple[Tensor, Tensor]:
    """Return the probability of all angles that are denser than `value`, and of all that are at least as dense.

    These angles form an arc around the mean. At the ends of the two arcs, the log-density is higher, or lower, by
    `equal` than the log-density at `value`. For the uniform density, the two probabilities are therefore 0 and 1. Both
    are float64.
    """
    kappa = concentration.double()
    sine, cosine = half_angle(value.double(), mean.double())
    square, rest = sine * sine, cosine * cosine
    change = equal / (2 * kappa)
    both = torch.stack([(square - change).clamp(min=0), (square + change).clamp(max=1)])
    outside = torch.stack([(rest + change).clamp(max=1), (rest - change).clamp(min=0)])
    within = (kappa * both < 0.1) & (both < outside)
    side, _ = _one_side(both.sqrt(), outside.sqrt(), kappa, within, height_and_deviation(kappa))
    low, high = torch.where(within, 2 * side, 1 - 2 * side)
    return low, high


def _one_side(
    sine: Tensor, cosine: Tensor, concentration: Tensor, within: Tensor, constants: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Return the probability of an arc on one side of the mean, and its derivative in κ.

    Angles are distances from the mean, in [0, π]. The arc begins at b = 0 and ends at t where `within` is true;
    elsewhere it begins at b = t and ends at π. The density at b is factored out. So the integrand at the angle b + s is
    exp(-2κ sin(s/2) sin(b + s/2)), which falls from 1; the integral ends where it has fallen to exp(-CUT).

    Args:
        sine: sin(t/2).
        cosine: cos(t/2).
        concentration: κ.
        within: whether the arc begins at the mean.
        constants: `height_and_deviation` of κ.
    """
    height, deviation = constants
    reach = CUT / (2 * concentration)
    start_sine, start_cosine = torch.where(within, 0, sine), torch.where(within, 1, cosine)
    # where 2κ sin²(θ/2) has risen by CUT, sin((θ-b)/2) = reach / sin((θ+b)/2), without cancellation
    square = start_sine * start_sine + reach
    end_sine, end_cosine = square.sqrt(), (start_cosine * start_cosine - reach).clamp(min=0).sqrt()
    cut = 2 * torch.asin((reach / (end_sine * start_cosine + end_cosine * start_sine)).clamp(max=1))
    whole = 2 * torch.where(within, torch.atan2(sine, cosine), torch.atan2(cosine, sine))
    width = torch.where(square < 1, torch.minimum(cut, whole), whole)
    full_sine = 2 * start_sine * start_cosine
    full_cosine = (start_cosine - start_sine) * (start_cosine + start_sine)
    total, moment = torch.zeros_like(width), torch.zeros_like(width)
    nodes = torch.tensor(NODES[40], dtype=width.dtype, device=width.device)
    # a few values are computed at many nodes at once, because each call of torch takes some microseconds
    for part in nodes.split(max(1, AT_ONCE // max(1, width.numel()))):
        place, weight = (column.reshape(-1, *(1,) * width.dim()) for column in part.unbind(-1))
        half = width * (place / 2)
        half_sine = torch.sin(half)
        fall = half_sine * (full_sine * torch.cos(half) + full_cosine * half_sine)
        share = weight * torch.exp(-2 * concentration * fall)
        total += share.sum(0)
        moment += (share * fall).sum(0)
    fallen = 2 * start_sine * start_sine
    scale = torch.exp(height - concentration * fallen) * width
    # the derivative of log p in κ is 1 - A - 2 sin²(θ/2)
    return scale * total, scale * ((deviation - fallen) * total - 2 * moment)


def _cdf_and_slopes(value: Tensor, mean: Tensor, concentration: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the distribution function, its derivative in the value (the density), and its derivative in κ."""
    sine, cosine = half_angle(value, mean)
    ahead = sine * cosine >= 0
    sine, cosine = sine.abs(), cosine.abs()
    angle = 2 * torch.atan2(sine, cosine)
    turns = torch.round((value - mean - torch.where(ahead, angle, -angle)) / (2 * math.pi))
    within = (concentration * sine * sine < 0.1) & (sine < cosine)
    mass, slope = _one_side(sine, cosine, concentration, within, height_and_deviation(concentration))
    sign = torch.where(ahead, 1.0, -1.0)
    fraction = torch.where(within, 0.5 + sign * mass, torch.where(ahead, 1 - mass, mass))
    density = torch.exp(log_height(concentration) - 2 * (concentration * sine) * sine)
    return turns + fraction, density, torch.where(within, sign, -sign) * slope


class _Cdf(Function):
    """Autograd function of the distribution function, for float64 arguments of one shape."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, mean: Tensor, concentration: Tensor) -> Tensor:
        probability, density, by_concentration = in_blocks(_cdf_and_slopes, value, mean, concentration)
        ctx.save_for_backward(density, by_concentration)
        return probability

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        density, by_concentration = ctx.saved_tensors
        return grad * density, -grad * density, grad * by_concentration


def _log_quotient(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the logarithm log((κ₂+2)/(κ₁+2)), a mask, and a step, for κ₁ in `first` and κ₂ in `second`.

    The mask is true where the magnitude of the logarithm is at most 1. There, integrals from κ₁ to κ₂ are computed by
    quadrature in log(x+2), because a difference of antiderivatives would lose digits. The step of the quadrature is the
    logarithm where the mask is true, and 0 elsewhere.
    """
    quotient = torch.log((second + 2) / (first + 2))
    near = quotient.abs() <= 1
    exact = torch.log1p(torch.where(near, (second - first) / (first + 2), 0))
    return torch.where(near, exact, quotient), near, torch.where(near, exact, 0)


class _Bregman(Function):
    """Autograd function of ∫_{κ₁}^{κ₂} (κ₂-x) A'(x) dx, with A(κ) = I1(κ)/I0(κ).

    This is the Bregman divergence of log I0: its height at κ₂ above its tangent at κ₁.
    """

    @staticmethod
    def forward(ctx: Any, first: Tensor, second: Tensor) -> Tensor:
        ctx.save_for_backward(first, second)
        log, near, step = _log_quotient(first, second)
        v = 2 / (first + 2)
        total = torch.zeros_like(step)
        for place, weight in NODES[14]:
            part = polynomial("ratio_slope", v * torch.exp(-place * step))
            total += weight * part * torch.expm1((1 - place) * step)
        rise = log / 2 - polynomial("log_peak", 2 / (second + 2)) + polynomial("log_peak", v)
        far = (second - first) * deviation_of(first) - rise
        return torch.where(near, 2 * step * total, far)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor]:
        first, second = ctx.saved_tensors
        v = 2 / (first + 2)
        # -(κ₂-κ₁) A'(κ₁), the product ordered so that nothing under- or overflows
        by_first = (first - second) * v * (v * polynomial("ratio_slope", v) / 2)
        return grad * by_first, grad * _RatioRise.apply(first, second)


class _RatioRise(Function):
    """Autograd function of the difference A(κ₂) - A(κ₁), with A(κ) = I1(κ)/I0(κ)."""

    @staticmethod
    def forward(ctx: Any, first: Tensor, second: Tensor) -> Tensor:
        ctx.save_for_backward(first, second)
        _, near, step = _log_quotient(first, second)
        v = 2 / (first + 2)
        total = torch.zeros_like(step)
        for place, weight in NODES[14]:
            scaled = v * torch.exp(-place * step)
            total += weight * scaled * polynomial("ratio_slope", scaled)
        return torch.where(near, step * total, deviation_of(first) - deviation_of(second))

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor]:
        first, second = ctx.saved_tensors
        return -grad * mean_resultant_slope(first), grad * mean_resultant_slope(second)
