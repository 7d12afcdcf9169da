"""Light of stored numbers, against kornia's."""

import kornia
import torch

from framework.geometry.light import eight_bit, linear


def test_light_is_that_of_another_library_and_comes_back() -> None:
    stored = torch.arange(256, dtype=torch.uint8)
    light = linear(stored)
    theirs = kornia.color.rgb_to_linear_rgb((stored / 255).expand(3, 1, 256))[0, 0]
    assert (light - theirs).abs().max() < 1e-6
    assert torch.equal(eight_bit(light), stored)
    assert eight_bit(torch.tensor([-1.0, 0.0, 2.0])).tolist() == [0, 0, 255]
