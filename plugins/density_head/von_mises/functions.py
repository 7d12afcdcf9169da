"""The von Mises density p(φ) = exp(κ cos(φ-μ)) / (2π I0(κ)) (thesis eq. 3.3), accurate from κ = 0 to 1e30.

No function subtracts two large numbers that nearly agree. The density is written as its height at the mean times
exp(-2κ sin²((φ-μ)/2)). The Bessel functions are computed by polynomials (coefficients.py) of functions that are smooth
from κ = 0 to infinity. Arguments broadcast, are float32 or float64, and κ ≥ 0 is finite.

The density's value and derivatives come from one pass, also under torch.compile. Large tensors on the CPU are computed
by compiled code (processor.py), others by torch operations, in blocks that fit a processor's cache. The difference of
the angles is in angles.py, the Bessel functions are in bessel.py, and integrals of the density are in integrals.py.
"""

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function

from plugins.density_head.von_mises import processor
from plugins.density_head.von_mises.angles import half_angle, half_products, in_single, parts_in_single
from plugins.density_head.von_mises.bessel import deviation_of, height_and_deviation, log_height, polynomial
from plugins.density_head.von_mises.blocks import BLOCK, in_blocks

SAMPLING_ROUNDS = 64
"""Largest number of proposals per sample.

At least 65.7 % of proposals are accepted, so that fewer than one sample in 10^29 has no accepted proposal after 64.
"""


def log_prob(value: Tensor, mean: Tensor, concentration: Tensor) -> Tensor:
    """Return the log-density, nats, with accurate first and second derivatives in all three arguments.

    The difference φ-μ is not rounded. float32 angles of any size are read modulo 2π exactly (under torch.compile and
    torch.func only up to 4e8 radians). float64 angles are read exactly up to 4e8 radians; larger ones have an error of
    one unit of their last digit. Arguments in half precision are computed in float32.
    """
    dtype = torch.promote_types(torch.promote_types(value.dtype, mean.dtype), concentration.dtype)
    if dtype.itemsize < 4:
        return log_prob(value.float(), mean.float(), concentration.float()).to(dtype)
    value, mean, concentration = value.to(dtype), mean.to(dtype), concentration.to(dtype)
    needs_gradient = value.requires_grad or mean.requires_grad or concentration.requires_grad
    if (torch.is_grad_enabled() and needs_gradient) or processor.is_transformed():
        return _apply(_LogProb, value, mean, concentration)[0]
    results = processor.density(value, mean, concentration, slopes=False)
    return (results or in_blocks(_value, value, mean, concentration))[0]


def mean_resultant(concentration: Tensor) -> Tensor:
    """Return A(κ) = I1(κ)/I0(κ) = E cos(φ-μ), to full relative precision for small and large κ."""
    return _apply(_Ratio, concentration)


def mean_deviation(concentration: Tensor) -> Tensor:
    """Return 1 - A(κ) = E 2 sin²((φ-μ)/2), to full relative precision for small and large κ."""
    return _apply(_OneMinusRatio, concentration)


def entropy(concentration: Tensor) -> Tensor:
    """Return the entropy κ(1 - A(κ)) - log_height(κ), nats; its derivative is -κ A'(κ)."""
    return _apply(_Entropy, concentration)


def mean_resultant_slope(concentration: Tensor) -> Tensor:
    """Return A'(κ) = 1 - A² - A/κ (Mardia & Jupp 2000, A.14), the Fisher information of κ."""
    part = 2 / (concentration + 2)
    return polynomial("ratio_slope", part) * part * part / 2


@torch.no_grad()
def concentration_of_moments(resultant: Tensor, deviation: Tensor) -> Tensor:
    """Return κ with A(κ) = resultant: the maximum-likelihood κ for a known mean (thesis eq. 3.5), float64.

    Args:
        resultant: R, the mean of cos(φ-μ); below 0 the result is κ = 0.
        deviation: V = 1 - R, the mean of 2 sin²((φ-μ)/2); for 0 the result is infinity. Both are needed: for a large κ
            rounding of R loses all digits, and for a small κ rounding of V does.
    """
    resultant, deviation = resultant.double().clamp(min=0), deviation.double()
    spread_out = resultant < 0.5
    # starting values within 10 %: the series of the inverse at R = 0 and V = 0 (Mardia & Jupp 2000, 5.3.9-10)
    small = resultant * (2 + resultant**2 + 5 / 6 * resultant**4)
    concentration = torch.where(spread_out, small, 0.5 / deviation + 0.25)
    tiny = torch.finfo(torch.float64).tiny
    for _ in range(8):  # Newton on logarithms, where both branches are nearly straight: 4 steps suffice
        wanted = torch.where(spread_out, resultant, deviation)
        have = torch.where(spread_out, mean_resultant(concentration), mean_deviation(concentration))
        error = torch.log1p((have - wanted) / wanted.clamp(min=tiny))
        slope = concentration * mean_resultant_slope(concentration) / have
        step = error / torch.where(spread_out, slope, -slope)
        # κ = 0 and infinity have no finite logarithm, and above 1e100 the slope underflows; these are exact already
        step = torch.where((concentration > 0) & (concentration < 1e100), step, 0)
        concentration = concentration * torch.exp(-step)
    return concentration


@torch.no_grad()
def sample(mean: Tensor, concentration: Tensor) -> Tensor:
    """Return one angle in [-π, π] per element, by rejection (Best & Fisher 1979), computed in float64.

    Proposals θ, the distances from the mean, come from a wrapped Cauchy density with the parameter ρ, as in the paper.
    The proposals are computed by t = tan(θ/2) = (1-ρ)/(1+ρ) tan(πu/2), with u uniform on (-1, 1), and 1 - cos θ =
    2t²/(1+t²). With these formulas nothing cancels at any κ. Elements without an accepted proposal after
    SAMPLING_ROUNDS keep their last proposal, so that the loop always ends.
    """
    mean, concentration = torch.broadcast_tensors(mean, concentration)
    samples = processor.sample(mean, concentration, BLOCK, SAMPLING_ROUNDS)
    if samples is not None:
        return samples
    kappa = concentration.double().flatten()
    block = BLOCK if kappa.device.type == "cpu" else max(1, kappa.numel())
    half_tangent = torch.cat([_half_tangent(part) for part in kappa.split(block)])
    angle = mean.double() + 2 * torch.atan(half_tangent).reshape(mean.shape)
    wrapped = torch.remainder(angle + math.pi, 2 * math.pi) - math.pi
    # angles that need no wrapping stay exact
    return torch.where(angle.abs() <= math.pi, angle, wrapped).to(mean.dtype)


def _half_tangent(kappa: Tensor) -> Tensor:
    """Return tan(θ/2) of one accepted proposal per element, where θ is the distance of the angle from the mean."""
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
    return half_tangent


def _propose(kappa: Tensor, scale: Tensor, floor: Tensor) -> tuple[Tensor, Tensor]:
    """Return tan(θ/2) of one wrapped Cauchy proposal of `sample` per element, and whether it is rejected."""
    uniform, accept = torch.rand(2, kappa.numel(), dtype=kappa.dtype, device=kappa.device)
    tangent = scale * torch.tan(math.pi * (uniform - 0.5))
    square = tangent * tangent
    cost = floor + kappa * (2 * square / (1 + square))
    return tangent, ~(accept < cost * torch.exp(1 - cost))


def _value(value: Tensor, mean: Tensor, concentration: Tensor) -> tuple[Tensor]:
    if in_single(value, mean):
        sine, cosine, small_sine, small_cosine = parts_in_single(value, mean)
        square = (sine * small_cosine + cosine * small_sine).square()
    else:
        square, _ = half_products(value, mean)
    # 2κ may overflow
    return (log_height(concentration) - concentration * (2 * square),)


def _value_and_slopes(value: Tensor, mean: Tensor, concentration: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    square, product = half_products(value, mean)
    height, deviation = height_and_deviation(concentration)
    return height - concentration * (2 * square), concentration * (2 * product), deviation - 2 * square


def slope(value: Tensor, mean: Tensor, concentration: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return log p, its derivative -κ sin(φ-μ), and its negative second derivative κ cos(φ-μ).

    The derivatives are with respect to φ, which is `value`. The results have no gradient.
    """
    square, product = half_products(value, mean)
    log_prob = log_height(concentration) - concentration * (2 * square)
    return log_prob, -2 * concentration * product, concentration * (1 - 2 * square)


def fall(value: Tensor, mean: Tensor, concentration: Tensor) -> Tensor:
    """Return log p at φ minus log p at the mean: -2κ sin²((φ-μ)/2) = κ(cos(φ-μ) - 1), nats."""
    sine, _ = half_angle(value, mean)
    return -2 * (concentration * sine) * sine


def _apply(function: type[Function], *arguments: Tensor) -> Any:
    """Return the result of an autograd function.

    `Function.apply` first binds the arguments to the signature of `forward`. That takes a tenth of the time for few
    elements, and is only needed in transforms and compiled code.
    """
    if torch.compiler.is_compiling() or processor.is_transformed():
        return function.apply(*arguments)
    return super(Function, function).apply(*arguments)  # pyright: ignore[reportAttributeAccessIssue]


class _LogProb(Function):
    """Autograd function of the log-density.

    `forward` computes the value and all derivatives in one pass, and `backward` only multiplies.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(value: Tensor, mean: Tensor, concentration: Tensor) -> tuple[Tensor, ...]:
        results = processor.density(value, mean, concentration, slopes=True)
        return results or in_blocks(_value_and_slopes, value, mean, concentration)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: tuple[Tensor, ...]) -> None:
        ctx.save_for_backward(*inputs, *output[1:])
        ctx.mark_non_differentiable(*output[1:])
        ctx.set_materialize_grads(False)  # otherwise zeros are made for the outputs that have no gradient

    @staticmethod
    def backward(ctx: Any, grad: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
        if grad is None:
            return None, None, None
        value, mean, concentration, by_mean, by_concentration = ctx.saved_tensors
        if torch.is_grad_enabled() and not torch.compiler.is_compiling():
            # For second derivatives, the first ones are computed by differentiable operations.
            sine, cosine = half_angle(value, mean)
            by_mean = 2 * concentration * sine * cosine
            by_concentration = mean_deviation(concentration) - 2 * sine * sine
        turning, of_concentration = processor.multiply(grad, by_mean, by_concentration)
        needed = ctx.needs_input_grad
        return (
            (-turning).sum_to_size(value.shape) if needed[0] else None,
            turning.sum_to_size(mean.shape) if needed[1] else None,
            of_concentration.sum_to_size(concentration.shape) if needed[2] else None,
        )


class _OfConcentration(Function):
    """Base of the autograd functions of κ alone."""

    generate_vmap_rule = True

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)


class _OneMinusRatio(_OfConcentration):
    """Autograd function of 1 - A(κ), with A(κ) = I1(κ)/I0(κ); its derivative is -A'(κ)."""

    @staticmethod
    def forward(concentration: Tensor) -> Tensor:
        return deviation_of(concentration)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (concentration,) = ctx.saved_tensors
        return -grad * mean_resultant_slope(concentration)


class _Ratio(_OfConcentration):
    """Autograd function of A(κ) = I1(κ)/I0(κ); its derivative is A'(κ)."""

    @staticmethod
    def forward(concentration: Tensor) -> Tensor:
        part = 1 / (1 + 2 / concentration)  # κ/(κ+2), without overflow, 0 at κ = 0
        return polynomial("ratio", 2 / (concentration + 2)) * part

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (concentration,) = ctx.saved_tensors
        return grad * mean_resultant_slope(concentration)


class _Entropy(_OfConcentration):
    @staticmethod
    def forward(concentration: Tensor) -> Tensor:
        height, deviation = height_and_deviation(concentration)
        # 0 · inf at infinite κ, where κ(1 - A) is 1/2
        return torch.where(concentration.isinf(), 0.5, concentration * deviation) - height

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (concentration,) = ctx.saved_tensors
        # -κ A'(κ), the product ordered so that nothing under- or overflows
        part = 2 / (concentration + 2)
        return grad * (-polynomial("ratio_slope", part) * (concentration * part) * part / 2)
