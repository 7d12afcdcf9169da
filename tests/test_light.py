"""Light of stored numbers, against kornia's."""

import kornia
import torch

from framework.geometry.light import eight_bit, encoded, linear


def test_light_is_that_of_another_library_and_comes_back() -> None:
    stored = torch.arange(256, dtype=torch.uint8)
    light = linear(stored)
    theirs = kornia.color.rgb_to_linear_rgb((stored / 255).expand(3, 1, 256))[0, 0]
    assert (light - theirs).abs().max() < 1e-6
    assert torch.equal(eight_bit(light), stored)
    assert eight_bit(torch.tensor([-1.0, 0.0, 2.0])).tolist() == [0, 0, 255]


def test_white_comes_back_as_white_with_the_curves_slope() -> None:
    """Not as 0.99999994, which is told from the 1 of empty ground."""
    for kind in (torch.float32, torch.float64):
        light = torch.tensor([1.0, 2.0, 1 - 1e-6], dtype=kind, requires_grad=True)
        found = encoded(light)
        assert found[:2].tolist() == [1.0, 1.0] and found[2] < 1
        (slope,) = torch.autograd.grad(found.sum(), light)
        torch.testing.assert_close(
            slope, torch.tensor([1.055 / 2.4, 0.0, 1.055 / 2.4], dtype=kind), rtol=1e-5, atol=0
        )
        assert (encoded(torch.rand(10_000, dtype=kind)) <= 1).all()
    assert encoded(linear(torch.tensor(255, dtype=torch.uint8))) == 1
