"""Conversion between the sRGB numbers of image files (IEC 61966-2-1) and linear RGB."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor


def linear_from_bytes(stored: UInt8[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Return linear RGB in [0, 1], float32, for 8-bit sRGB numbers `stored`."""
    return linear_from_srgb(stored.float() / 255)


def linear_from_srgb(numbers: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Return linear RGB in [0, 1] for sRGB numbers; numbers outside of [0, 1] are clamped.

    The function is the inverse of `srgb_from_linear`.
    """
    share = numbers.clamp(0, 1)
    return torch.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def bytes_from_linear(linear: Float[Tensor, "*any"]) -> UInt8[Tensor, "*any"]:
    """Return 8-bit sRGB numbers for linear RGB; values outside of [0, 1] are clamped."""
    return (srgb_from_linear(linear) * 255).round().to(torch.uint8)


def srgb_from_linear(linear: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Return sRGB numbers in [0, 1] for linear RGB, not rounded; their gradient is 0 outside of [0, 1]."""
    linear = linear.clamp(0, 1)
    # 1.055 x - 0.055, written so that white is 1 to the bit, since white pixels are recognised by this value
    curve = 1 + 1.055 * (linear.clamp(min=1e-8) ** (1 / 2.4) - 1)
    return torch.where(linear <= 0.0031308, linear * 12.92, curve)
