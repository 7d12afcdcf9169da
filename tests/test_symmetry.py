import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from framework.geometry import quaternions
from framework.geometry.symmetry import (
    GROUPS,
    draw_members,
    draw_noise,
    log_blurred,
    nearest_distance,
    noise_concentration,
    rotations_of,
)

SCIPY = {"none": "C1", "tetrahedral": "T", "octahedral": "O", "icosahedral": "I"}


def scipy_rotations(turn):
    return Rotation.from_quat(turn[:, [1, 2, 3, 0]].numpy())


def random_rotations(count, seed=0):
    turn = torch.randn(count, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return turn / turn.norm(dim=-1, keepdim=True)


@pytest.mark.parametrize("group", SCIPY)
def test_finite_groups_are_closed_and_as_large_as_scipys(group):
    members = rotations_of(group)
    assert len(members) == len(Rotation.create_group(SCIPY[group]))
    products = quaternions.product(members[:, None], members[None]).flatten(0, 1)
    assert (products @ members.T).abs().amax(-1).min() > 1 - 1e-12
    overlap = (members @ members.T).abs() - torch.eye(len(members)).double()
    assert overlap.max() < 0.9  # no rotation occurs twice


def test_a_continuous_group_has_no_list_of_rotations():
    with pytest.raises(ValueError, match="no finite group"):
        rotations_of("conical")


@pytest.mark.parametrize("group", GROUPS)
def test_distance_is_the_least_over_many_members(group):
    first, second = random_rotations(40), random_rotations(40, 1)
    members = draw_members(3000, group, torch.Generator().manual_seed(2))
    equivalent = quaternions.product(first[:, None], members)
    cosine = (equivalent * second[:, None]).sum(-1).abs().amax(-1)
    distance = nearest_distance(first, second, group)
    assert (2 * cosine.clamp(max=1).acos() - distance).abs().max() < 2e-3
    same = quaternions.product(first, members[:40])
    assert nearest_distance(first, same, group).max() < 1e-7


@pytest.mark.parametrize("deviation_deg", [2, 10, 60])
def test_noise_follows_its_density(deviation_deg):
    concentration = noise_concentration(math.radians(deviation_deg))
    noise = draw_noise(20_000, concentration, torch.Generator().manual_seed(0))
    angle = scipy_rotations(noise).magnitude()
    grid = np.linspace(0, math.pi, 200_001)
    density = (1 - np.cos(grid)) * np.exp(2 * concentration * (np.cos(grid) - 1))
    below = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2)])
    assert kstest(angle, lambda x: np.interp(x, grid, below / below[-1])).pvalue > 1e-3
    assert kstest(noise[:, 1] / noise[:, 1:].norm(dim=-1), "uniform", (-1, 2)).pvalue > 1e-3


@pytest.mark.parametrize("group", GROUPS)
def test_blurred_density_is_the_mean_of_the_noise_density_over_the_group(group):
    concentration = noise_concentration(math.radians(30))
    first, second = random_rotations(20), random_rotations(20, 1)
    members = draw_members(100_000, group, torch.Generator().manual_seed(3))
    if group not in ("conical", "cylindrical"):
        members = rotations_of(group)
    between = quaternions.product(quaternions.inverse(first), second)
    cosine = 2 * (between @ members.T).square() - 1
    grid = (np.arange(100_000) + 0.5) / 100_000 * math.pi
    constant = np.mean((1 - np.cos(grid)) * np.exp(2 * concentration * (np.cos(grid) - 1)))
    density = torch.exp(2 * concentration * (cosine - 1)) / constant
    expected, error = density.mean(-1), density.var(-1, correction=0).sqrt() / len(members) ** 0.5
    actual = log_blurred(first, second, group, concentration).exp()
    limit = 5 * error if len(members) == 100_000 else 1e-8 * expected
    assert ((actual - expected).abs() <= limit + 1e-12).all()


@pytest.mark.parametrize("group", GROUPS)
def test_blurred_density_integrates_to_one_and_labels_follow_it(group):
    concentration = noise_concentration(math.radians(25))
    first = random_rotations(1).expand(200_000, 4)
    generator = torch.Generator().manual_seed(4)
    everywhere = random_rotations(200_000, 5)
    density = log_blurred(first, everywhere, group, concentration).exp()
    assert abs(density.mean() - 1) < 5 * density.std() / 200_000**0.5
    noise = draw_noise(200_000, concentration, generator)
    labels = quaternions.product(quaternions.product(first, draw_members(200_000, group, generator)), noise)
    # E_p[1/(1 + p)] is ∫ p/(1 + p), which is E_uniform[p/(1 + p)]
    of_labels = 1 / (1 + log_blurred(first, labels, group, concentration).exp())
    of_uniform = density / (1 + density)
    noise_level = ((of_labels.var() + of_uniform.var()) / 200_000) ** 0.5
    assert (of_labels.mean() - of_uniform.mean()).abs() < 5 * noise_level
