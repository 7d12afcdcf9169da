"""The von Mises density p(φ) = exp(κ cos(φ-μ)) / (2π I0(κ)) (thesis eq. 3.3), accurate from κ = 0 to 1e30.

Nothing here subtracts two large numbers that nearly agree: the density is written as its height at the mean
times exp(-2κ sin²((φ-μ)/2)), and the Bessel functions come from polynomials (coefficients.py) of what stays
smooth from κ = 0 to infinity. Arguments broadcast, are float32 or float64, and κ ≥ 0.
"""

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function

from plugins.von_mises.coefficients import PIECES

SAMPLING_ROUNDS = 64
"""At least 65.7 % of proposals are accepted: after 64 rounds fewer than one lane in 10^29 is left."""


def log_prob(value: Tensor, mean: Tensor, concentration: Tensor) -> Tensor:
    """Log-density, nats, with accurate gradients in all three arguments, also the second ones.

    The difference φ-μ is never rounded, so that angles of a million radians are read modulo 2π exactly.
    """
    dtype = torch.promote_types(torch.promote_types(value.dtype, mean.dtype), concentration.dtype)
    value, mean, concentration = value.to(dtype), mean.to(dtype), concentration.to(dtype)
    return _Fall.apply(value, mean, concentration) + log_peak(concentration)


def log_peak(concentration: Tensor) -> Tensor:
    """Log-density at the mean, κ - log(2π I0(κ)), nats."""
    return _LogPeak.apply(concentration)


def mean_resultant(concentration: Tensor) -> Tensor:
    """A(κ) = I1(κ)/I0(κ) = E cos(φ-μ), to full relative precision at both ends."""
    return _Ratio.apply(concentration)


def mean_deviation(concentration: Tensor) -> Tensor:
    """1 - A(κ) = E 2 sin²((φ-μ)/2), to full relative precision at both ends."""
    return _OneMinusRatio.apply(concentration)


def entropy(concentration: Tensor) -> Tensor:
    """κ(1 - A(κ)) - log_peak(κ), nats; its derivative is -κ A'(κ)."""
    return _Entropy.apply(concentration)


def mean_resultant_slope(concentration: Tensor) -> Tensor:
    """A'(κ) = 1 - A² - A/κ (Mardia & Jupp 2000, A.14), the Fisher information of κ."""
    smooth = _polynomial("ratio_slope", concentration)
    part = 2 / (concentration + 2)
    return smooth * part * part / 2


def half_angle(value: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
    """sin and cos of (φ-μ)/2, the difference taken without rounding."""
    high = value - mean
    with torch.no_grad():
        # Knuth's two-sum: high + low is φ-μ exactly
        back = value - high
        low = (value - (high + back)) + (back - mean)
    sine, cosine = torch.sin(high / 2), torch.cos(high / 2)
    small_sine, small_cosine = torch.sin(low / 2), torch.cos(low / 2)
    return sine * small_cosine + cosine * small_sine, cosine * small_cosine - sine * small_sine


@torch.no_grad()
def concentration_of_moments(resultant: Tensor, deviation: Tensor) -> Tensor:
    """κ with A(κ) = resultant: the maximum-likelihood κ of angles about a known mean (eq. 3.5), float64.

    Args:
        resultant: R, the mean of cos(φ-μ); below 0 it is answered with κ = 0.
        deviation: V = 1 - R, the mean of 2 sin²((φ-μ)/2), given beside it because R carries no digits of a
            large κ and V none of a small one. 0 is answered with infinity.
    """
    resultant, deviation = resultant.double().clamp(min=0), deviation.double()
    spread_out = resultant < 0.5
    # starts within 10 %: the series of the inverse at R = 0 and V = 0 (Mardia & Jupp 2000, 5.3.9-10)
    small = resultant * (2 + resultant**2 + 5 / 6 * resultant**4)
    concentration = torch.where(spread_out, small, 0.5 / deviation + 0.25)
    tiny = torch.finfo(torch.float64).tiny
    for _ in range(8):  # Newton on logarithms, where both branches are nearly straight: 4 steps suffice
        wanted = torch.where(spread_out, resultant, deviation)
        have = torch.where(spread_out, mean_resultant(concentration), mean_deviation(concentration))
        error = torch.log1p((have - wanted) / wanted.clamp(min=tiny))
        slope = concentration * mean_resultant_slope(concentration) / have
        step = error / torch.where(spread_out, slope, -slope)
        # the two ends have no logarithm: they are right already
        step = torch.where((concentration > 0) & concentration.isfinite(), step, 0)
        concentration = concentration * torch.exp(-step)
    return concentration


@torch.no_grad()
def sample(mean: Tensor, concentration: Tensor) -> Tensor:
    """One angle in [-π, π] per element, by rejection (Best & Fisher 1979), float64 inside.

    Best and Fisher propose from a wrapped Cauchy of the same peak; with t = tan(θ/2) its proposal is
    t = (1-ρ)/(1+ρ) tan(πu/2), u uniform on (-1, 1), and 1 - cos θ = 2t²/(1+t²): nothing cancels at any κ.
    Lanes that have not accepted after SAMPLING_ROUNDS keep their last proposal: no input can hang the loop.
    """
    mean, concentration = torch.broadcast_tensors(mean, concentration)
    kappa = concentration.double().flatten()
    root = torch.hypot(torch.ones_like(kappa), 2 * kappa)
    tau = 1 + root
    span = tau + torch.sqrt(2 * tau)  # 2κ/ρ
    gap = (1 + 1 / (root + 2 * kappa) + torch.sqrt(2 * tau)) / span  # 1 - ρ
    scale = gap / (1 + 2 * kappa / span)
    floor = gap * gap * span / 4  # κ(r-1) with r = (1+ρ²)/(2ρ)
    half_tangent, rejected = _propose(kappa, scale, floor)
    lanes = rejected.nonzero().flatten()
    for _ in range(SAMPLING_ROUNDS - 1):
        if lanes.numel() == 0:
            break
        half_tangent[lanes], rejected = _propose(kappa[lanes], scale[lanes], floor[lanes])
        lanes = lanes[rejected]
    angle = mean.double() + 2 * torch.atan(half_tangent).reshape(mean.shape)
    wrapped = torch.remainder(angle + math.pi, 2 * math.pi) - math.pi
    # angles that need no wrapping keep their last digits
    return torch.where(angle.abs() <= math.pi, angle, wrapped).to(mean.dtype)


def _propose(kappa: Tensor, scale: Tensor, floor: Tensor) -> tuple[Tensor, Tensor]:
    """tan(θ/2) of one wrapped Cauchy proposal per lane, and whether it is rejected."""
    uniform, accept = torch.rand(2, kappa.numel(), dtype=kappa.dtype, device=kappa.device)
    tangent = scale * torch.tan(math.pi * (uniform - 0.5))
    square = tangent * tangent
    cost = floor + kappa * (2 * square / (1 + square))
    return tangent, ~(accept < cost * torch.exp(1 - cost))


def _polynomial(name: str, concentration: Tensor) -> Tensor:
    """One of the smooth functions of v = 2/(κ+2) in fit_coefficients.py; branch-free, so that it compiles."""
    dtype = "float32" if concentration.dtype == torch.float32 else "float64"
    tracked = torch.is_grad_enabled() and concentration.requires_grad
    v = 2 / (concentration + 2)
    found = None
    for middle, half_width, coefficients in PIECES[dtype][name]:
        y = (v - middle) / half_width
        total = torch.full_like(y, coefficients[-1])
        for coefficient in coefficients[-2::-1]:
            # in place it takes half the time, but autograd needs the steps
            total = total * y + coefficient if tracked else total.mul_(y).add_(coefficient)
        found = total if found is None else torch.where(v < middle - half_width, found, total)
    assert found is not None
    return found


def _log_peak(concentration: Tensor) -> Tensor:
    return torch.log(concentration + 2) / 2 - _polynomial("log_peak", concentration)


def _one_minus_ratio(concentration: Tensor) -> Tensor:
    return _polynomial("one_minus_ratio", concentration) / (1 + 2 * concentration)


class _Fall(Function):
    """-2κ sin²((φ-μ)/2), which is κ(cos(φ-μ) - 1); its gradients are -κ sin(φ-μ) and the fall of κ = 1."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, mean: Tensor, concentration: Tensor) -> Tensor:
        sine, cosine = half_angle(value, mean)
        unit_fall = -2 * sine * sine
        ctx.save_for_backward(value, mean, concentration, unit_fall, 2 * sine * cosine)
        return concentration * unit_fall

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        value, mean, concentration, unit_fall, sine = ctx.saved_tensors
        if torch.is_grad_enabled():  # a second derivative is wanted: the same in operations that have one
            half_sine, half_cosine = half_angle(value, mean)
            unit_fall, sine = -2 * half_sine * half_sine, 2 * half_sine * half_cosine
        turning = grad * concentration * sine
        needed = ctx.needs_input_grad
        return (
            (-turning).sum_to_size(value.shape) if needed[0] else None,
            turning.sum_to_size(mean.shape) if needed[1] else None,
            (grad * unit_fall).sum_to_size(concentration.shape) if needed[2] else None,
        )


class _LogPeak(Function):
    """Its derivative is 1 - A(κ)."""

    @staticmethod
    def forward(ctx: Any, concentration: Tensor) -> Tensor:
        ctx.save_for_backward(concentration)
        return _log_peak(concentration)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (concentration,) = ctx.saved_tensors
        return grad * mean_deviation(concentration)


class _OneMinusRatio(Function):
    """Its derivative is -A'(κ)."""

    @staticmethod
    def forward(ctx: Any, concentration: Tensor) -> Tensor:
        ctx.save_for_backward(concentration)
        return _one_minus_ratio(concentration)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (concentration,) = ctx.saved_tensors
        return -grad * mean_resultant_slope(concentration)


class _Ratio(Function):
    """A(κ); its derivative is A'(κ)."""

    @staticmethod
    def forward(ctx: Any, concentration: Tensor) -> Tensor:
        ctx.save_for_backward(concentration)
        part = 1 / (1 + 2 / concentration)  # κ/(κ+2), without overflow, 0 at κ = 0
        return _polynomial("ratio", concentration) * part

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (concentration,) = ctx.saved_tensors
        return grad * mean_resultant_slope(concentration)


class _Entropy(Function):
    @staticmethod
    def forward(ctx: Any, concentration: Tensor) -> Tensor:
        ctx.save_for_backward(concentration)
        part = 1 / (2 + 1 / concentration)  # κ/(1+2κ)
        return part * _polynomial("one_minus_ratio", concentration) - _log_peak(concentration)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (concentration,) = ctx.saved_tensors
        # -κ A'(κ), the product ordered so that nothing under- or overflows
        part = 2 / (concentration + 2)
        return grad * (-_polynomial("ratio_slope", concentration) * (concentration * part) * part / 2)
