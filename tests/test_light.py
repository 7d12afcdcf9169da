"""Conversion between sRGB and linear RGB, compared with kornia."""

import kornia
import pytest
import torch

from framework.geometry.srgb import bytes_from_linear, linear_from_bytes, linear_from_srgb, srgb_from_linear


def test_light_is_that_of_another_library_and_comes_back() -> None:
    stored = torch.arange(256, dtype=torch.uint8)
    light = linear_from_bytes(stored)
    theirs = kornia.color.rgb_to_linear_rgb((stored / 255).expand(3, 1, 256))[0, 0]
    assert (light - theirs).abs().max() < 1e-6
    assert torch.equal(bytes_from_linear(light), stored)
    assert bytes_from_linear(torch.tensor([-1.0, 0.0, 2.0])).tolist() == [0, 0, 255]


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_white_and_black_are_exact_and_numbers_rise_with_light(kind: torch.dtype) -> None:
    """White and black must be exact, since a white background is recognised by its value."""
    ends = torch.tensor([0.0, 1.0], dtype=kind)
    assert torch.equal(srgb_from_linear(ends), ends)
    assert torch.equal(linear_from_srgb(ends), ends)
    light = torch.linspace(0, 1, 100_001, dtype=kind)
    # the standard's own constants leave a step of 3e-8 between line and curve
    assert (srgb_from_linear(light).diff() > -1e-7).all()
    assert (srgb_from_linear(light[:-1]) < 1).all()
    torch.testing.assert_close(linear_from_srgb(srgb_from_linear(light)), light, rtol=0, atol=1e-6)
    # ends included, with the curve's slope
    given = torch.tensor([1.0, 2.0, 1 - 1e-6], dtype=kind, requires_grad=True)
    (slope,) = torch.autograd.grad(srgb_from_linear(given).sum(), given)
    torch.testing.assert_close(
        slope, torch.tensor([1.055 / 2.4, 0.0, 1.055 / 2.4], dtype=kind), rtol=1e-5, atol=0
    )
