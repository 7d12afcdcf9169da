"""Between the numbers of image files and light: sRGB (IEC 61966-2-1) to and from linear."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor


def linear(stored: UInt8[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Light in [0, 1], float32, of 8-bit numbers."""
    return light_of(stored.float() / 255)


def light_of(numbers: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Light in [0, 1] of sRGB numbers in [0, 1]; what lies outside is cut off. The inverse of `encoded`."""
    share = numbers.clamp(0, 1)
    return torch.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def eight_bit(light: Float[Tensor, "*any"]) -> UInt8[Tensor, "*any"]:
    """8-bit numbers of light; what lies outside of [0, 1] is cut off."""
    return (encoded(light) * 255).round().to(torch.uint8)


def encoded(light: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """The same before they are rounded, in [0, 1]; with a gradient where light is inside of [0, 1]."""
    light = light.clamp(0, 1)
    found = torch.where(light <= 0.0031308, light * 12.92, 1.055 * light.clamp(min=1e-8) ** (1 / 2.4) - 0.055)
    # 1.055 - 0.055 is rounded to 0.99999994: white ground, which is told by being 1, stays 1; with the curve's slope
    return torch.where(light == 1, 1 + (light - 1) * (1.055 / 2.4), found)
