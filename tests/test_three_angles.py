"""Tests of the adaptive quadrature of densities of three angles against a closed form."""

import math
from itertools import product

import pytest
import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular
from framework.testing.three_angles import cells_of_three_angles

RANGES = ((-math.pi, math.pi), (-math.pi / 2, math.pi / 2), (-math.pi, math.pi))
SHARE = 0.01


class Tips(Distribution):
    """Density SHARE · Σ 1/r, where r is the distance from each of several tips; it does not integrate to 1.

    Args:
        place: Places of the tips, (rows, tip, 3).
        stated_mode: Mode that the density states, (rows, 3).
    """

    def __init__(self, place: Tensor, stated_mode: Tensor) -> None:
        self.place, self.stated_mode = place, stated_mode
        super().__init__(place.shape[:1], torch.Size((3,)), validate_args=False)

    @property
    def mode(self) -> Tensor:
        return self.stated_mode

    @property
    def support(self) -> Circular:
        return Circular(RANGES)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        return torch.zeros(*sample_shape, *self.batch_shape, 3, dtype=torch.float64)

    def log_prob(self, value: Tensor) -> Tensor:
        return (SHARE / (value.unsqueeze(-2) - self.place).norm(dim=-1)).sum(-1).log()


def potential(corner: Tensor) -> Tensor:
    """Return an antiderivative of 1/r in x, y and z at corners (..., 3) (MacMillan 1930, art. 43)."""
    total = torch.zeros_like(corner[..., 0])
    distance = corner.norm(dim=-1)
    for axis in range(3):
        x, y, z = (corner[..., (axis + step) % 3] for step in range(3))
        total += x * y * (z + distance).log() - x * x / 2 * torch.atan(y * z / (x * distance))
    return total


@pytest.mark.parametrize("mode", ["a tip", "elsewhere", "NaN"])
def test_cells_hold_their_share_of_a_density_with_sharp_tips(mode):
    generator = torch.Generator().manual_seed(3)
    place = torch.rand(4, 2, 3, generator=generator, dtype=torch.float64) * 2 - 1
    stated = {"a tip": place[:, 0], "elsewhere": place[:, 0] + 0.3, "NaN": place[:, 0] * math.nan}[mode]
    borders, mass = cells_of_three_angles(Tips(place, stated), 6)
    expected = torch.zeros(6, 6, 6, 4, dtype=torch.float64)
    for ends in product((0, 1), repeat=3):
        corner = torch.stack(
            torch.meshgrid(
                *[border[end : end + 6] for border, end in zip(borders, ends, strict=True)], indexing="ij"
            ),
            -1,
        )
        sign = -1 if sum(ends) % 2 == 0 else 1
        expected += sign * SHARE * potential(corner[..., None, None, :] - place).sum(-1)
    assert 0.3 < expected.sum((0, 1, 2)).min() < 1.5
    torch.testing.assert_close(mass.sum((0, 1, 2)), expected.sum((0, 1, 2)), rtol=0, atol=1e-6)
    torch.testing.assert_close(mass, expected, rtol=0, atol=1e-6)
