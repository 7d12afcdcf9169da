"""Tests of points within balls against a loop over all pairs."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from plugins.encoder.point_sets.balls import find_within

CLOUD = st.lists(st.tuples(*[st.sampled_from([-1.5, -0.5, 0.0, 0.5, 1.0])] * 3), min_size=1, max_size=12)
"""Clouds with equal points, and with distances equal to the radius."""


def by_hand(clouds, centroids, radius, most):
    rows, start = [], 0
    for cloud in clouds:
        for centre in cloud[:centroids]:
            near = [row for row, point in enumerate(cloud) if np.square(point - centre).sum() <= radius**2]
            chosen = near[:most] + near[:1] * (most - len(near))
            rows.append([start + row for row in chosen])
        start += len(cloud)
    return rows


@given(
    st.lists(CLOUD, min_size=1, max_size=3),
    st.integers(1, 14),
    st.sampled_from([0.25, 0.5, 1.0, 10.0]),
    st.integers(1, 14),
    st.sampled_from([torch.float32, torch.float64]),
)
@settings(max_examples=100, deadline=None)
def test_a_ball_holds_the_first_points_within_its_radius(points, centroids, radius, most, dtype):
    clouds = [np.array(cloud) for cloud in points]
    places = torch.from_numpy(np.concatenate(clouds)).to(dtype)
    counts = torch.tensor([len(cloud) for cloud in clouds])
    neighbours = find_within(places, counts, centroids, radius, most)
    assert neighbours.tolist() == by_hand(clouds, centroids, radius, most)


def test_no_cloud_has_no_ball():
    assert find_within(torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64), 5, 1.0, 4).shape == (0, 4)


def test_what_has_a_gradient_is_read_too():
    places = torch.randn(9, 3, requires_grad=True)
    assert find_within(places, torch.tensor([4, 5]), 2, 0.5, 3).shape == (4, 3)
