"""Farthest-point sampling, compared with a loop that computes all distances again in each step."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.geometry.clouds import pad
from framework.geometry.farthest import farthest

WILD = st.lists(st.tuples(*[st.sampled_from([-1.0, 0.0, 1.0])] * 3), min_size=1, max_size=20)
"""Return clouds with equal points and equal distances."""


def by_hand(cloud, count):
    """Return the farthest-point sampling, with all distances computed again in each step."""
    start = np.linalg.norm(cloud - cloud.mean(0), axis=1)
    chosen = [int(start.argmax())]
    while len(chosen) < min(count, len(cloud)):
        distance = np.linalg.norm(cloud[:, None] - cloud[chosen], axis=-1).min(1)
        distance[chosen] = -1
        chosen.append(int(distance.argmax()))
    return [chosen[number % len(cloud)] for number in range(count)]


def drawn(*lengths):
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(length, 3, generator=generator, dtype=torch.float64) * 30 + 7 for length in lengths]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [1, 5, 30, 77])
def test_it_agrees_with_a_loop_whatever_stands_beside_and_behind_a_cloud(count, dtype):
    clouds = [cloud.to(dtype) for cloud in drawn(30, 1, 12)]
    found = farthest(pad(clouds), torch.tensor([30, 1, 12]), count)
    for row, cloud in zip(found, clouds, strict=True):
        assert row.tolist() == by_hand(cloud.double().numpy(), count)
        assert torch.equal(row, farthest(cloud[None], torch.tensor([len(cloud)]), count)[0])
    assert not math.isfinite(float(pad(clouds).sum()))  # there was padding


@given(WILD, st.integers(1, 30))
@settings(max_examples=60, deadline=None)
def test_of_duplicates_each_is_taken_once_before_any_is_twice(points, count):
    cloud = torch.tensor(points, dtype=torch.float64)
    found = farthest(cloud[None], torch.tensor([len(cloud)]), count)[0].tolist()
    assert len(set(found[: len(cloud)])) == min(count, len(cloud))
    # no later point is farther from those before it than an earlier one was, but for the first
    gaps = [
        float((cloud[found[:step]] - cloud[found[step]]).norm(dim=1).min()) for step in range(1, len(found))
    ]
    assert all(after <= before + 1e-12 for before, after in itertools.pairwise(gaps))


@given(WILD, st.integers(1, 20), st.integers(1, 20))
@settings(max_examples=60, deadline=None)
def test_fewer_are_the_beginning_of_more_and_of_their_own_order(points, few, many):
    few, many = sorted((few, many))
    cloud, size = torch.tensor([points], dtype=torch.float64), torch.tensor([len(points)])
    found = farthest(cloud, size, many)[0]
    assert torch.equal(farthest(cloud, size, few)[0], found[:few])
    # the first of them given, the greedy choice among those chosen is the order in which they were
    chosen = cloud[0, found[: len(points)]].numpy()
    order = [0]
    while len(order) < len(chosen):
        distance = ((chosen[:, None] - chosen[order]) ** 2).sum(-1).min(1)
        distance[order] = -1
        order.append(int(distance.argmax()))
    np.testing.assert_array_equal(chosen[order], chosen)


def test_the_places_do_not_depend_on_the_order_of_the_points():
    cloud, size = drawn(50)[0], torch.tensor([50])
    turned = cloud[torch.randperm(50, generator=torch.Generator().manual_seed(1))]
    first, second = farthest(cloud[None], size, 20)[0], farthest(turned[None], size, 20)[0]
    assert torch.equal(cloud[first], turned[second])
    assert torch.equal(farthest(cloud[None] * 2 - 5, size, 20)[0], first)


def test_no_cloud_and_no_point_wanted():
    assert farthest(torch.zeros(0, 4, 3), torch.zeros(0, dtype=torch.int64), 3).shape == (0, 3)
    assert farthest(torch.zeros(2, 4, 3), torch.tensor([4, 2]), 0).shape == (2, 0)
