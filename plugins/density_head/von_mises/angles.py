"""Sine and cosine of half the difference of two angles, without rounding of the difference.

This holds for any number of full rotations between the two angles φ (`value`) and μ (`mean`).
"""

import math

import torch
from torch import Tensor

from plugins.density_head.von_mises.processor import is_transformed

_PI = tuple(
    float.fromhex(part)
    for part in ("0x1.921fb54p+1", "0x1.10b461p-29", "0x1.a62633p-57", "0x1.45c06e0e68948p-85")
)
"""Parts of π: three of 27 bits, whose multiples by an integer below 2^26 are exact, and a rest."""


def half_angle(value: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
    """Return sin((φ-μ)/2) and cos((φ-μ)/2) for φ in `value` and μ in `mean`, without rounding of φ-μ.

    Both are correct up to one common sign.
    """
    if in_single(value, mean):
        return _half_angle_in_single(value, mean)
    sine, cosine, odd = _reduce(value, mean)
    return torch.where(odd > 0, cosine, sine), torch.where(odd > 0, -sine, cosine)


def half_products(value: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
    """Return sin²((φ-μ)/2) and sin((φ-μ)/2) cos((φ-μ)/2) for φ in `value` and μ in `mean`."""
    if in_single(value, mean):
        sine, cosine = _half_angle_in_single(value, mean)
        return sine * sine, sine * cosine
    sine, cosine, odd = _reduce(value, mean)
    # Arithmetic replaces `where`: a compiler that splits value and gradient would store a mask, at several times the
    # cost of everything else.
    square = sine * sine
    return square + odd * (cosine * cosine - square), (1 - 2 * odd) * (sine * cosine)


def in_single(value: Tensor, mean: Tensor) -> bool:
    """Return whether to compute with the angles in float32 alone, instead of partly in float64.

    The result is true if both angles are float32 and no compiler or transform of torch.func prevents reading their
    values.
    """
    if torch.compiler.is_compiling() or is_transformed():
        return False
    return value.dtype == mean.dtype == torch.float32


def _half_angle_in_single(value: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
    """Return sin((φ-μ)/2) and cos((φ-μ)/2) as `half_angle` does, for float32 arguments and in float32 alone."""
    sine, cosine, small_sine, small_cosine = parts_in_single(value, mean)
    return sine * small_cosine + cosine * small_sine, cosine * small_cosine - sine * small_sine


def parts_in_single(value: Tensor, mean: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return sin(d/2), cos(d/2), sin(e/2) and cos(e/2), where d is φ-μ rounded to float32, and e the rounding error.

    φ is `value`, and μ is `mean`. This takes fewer operations than `_reduce`, because float32's sine and cosine are
    also exact for large angles.
    """
    high = value - mean
    with torch.no_grad():
        low = _rounding_error(value, mean, high) / 2
        square = low * low  # below 2^-10 for angles up to 1e6 rad
        small_sine, small_cosine = low - low * square / 6, 1 - square / 2
        far = square > 2**-10
        if far.device.type != "cpu" or bool(far.any()):  # reading `far` would synchronise a device
            small_sine = torch.where(far, torch.sin(low), small_sine)
            small_cosine = torch.where(far, torch.cos(low), small_cosine)
    half = high / 2
    return torch.sin(half), torch.cos(half), small_sine, small_cosine


def _rounding_error(value: Tensor, mean: Tensor, high: Tensor) -> Tensor:
    """Return the rounding error of `high`, the rounded difference of `value` and `mean`, by Knuth's two-sum.

    `high` plus this error is the exact difference.
    """
    back = value - high
    return (value - (high + back)) + (back - mean)


def _reduce(value: Tensor, mean: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return sin(ρ/2), cos(ρ/2) and a mask: 1 where n is odd, 0 where n is even.

    The integer n and the rest ρ are those of φ-μ = nπ + ρ with the smallest |ρ|, for φ in `value` and μ in `mean`.
    """
    if value.dtype == torch.float32 and mean.dtype == torch.float32:
        high = value.double() - mean.double()
        low = None
    else:
        high = value - mean
        with torch.no_grad():
            low = _rounding_error(value, mean, high)
    with torch.no_grad():
        count = torch.round(high * (1 / math.pi))
        odd = 2 * torch.frac(count * 0.5).abs().to(value.dtype)
    rest = high - count * _PI[0] - count * _PI[1] - count * _PI[2]
    rest = (rest.float() if low is None else rest - count * _PI[3] + low) * 0.5
    sine, cosine = _sine_and_cosine(rest)
    return sine, cosine, odd


def _sine_and_cosine(angle: Tensor) -> tuple[Tensor, Tensor]:
    """Return sine and cosine of `angle`, which lies in [-π/4, π/4].

    Other angles occur only for numbers so large that neighbouring floats differ by a whole turn; the result then has no
    meaning.
    """
    if not torch.compiler.is_compiling():
        return torch.sin(angle), torch.cos(angle)
    angle = angle.clamp(-0.8, 0.8)
    # Taylor's series, to 1e-17 and 2e-9: the functions that the compiler calls reduce the angle once more
    square = angle * angle
    count = 8 if angle.dtype == torch.float64 else 4
    sine, cosine = torch.zeros_like(square), torch.zeros_like(square)
    for j in range(count, 0, -1):
        sine = (sine + (-1) ** j / math.factorial(2 * j + 1)) * square
        cosine = (cosine + (-1) ** j / math.factorial(2 * j)) * square
    return sine * angle + angle, 1 + cosine
