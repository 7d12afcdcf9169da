import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from framework.geometry.clouds import normalise_clouds, sizes
from framework.testing.cloud_encoders import batch_of
from plugins.encoder.grids.occupancy import decode, occupancy

DTYPES = [torch.float32, torch.float64]


def build_encoder(shape=(40, 3), **config):
    return build("encoder", resolve("encoder", {"name": "occupancy", **config}), input_shape=shape)


def grids_of(encoder, clouds, side):
    """Return the features of clouds, which must be one number of the clouds' dtype for each cell."""
    features = encoder(clouds)
    assert features.dtype == clouds.dtype
    assert features.shape == (len(clouds), 1, side, side, side)
    return features


def by_hand(cloud, side):
    """Return the occupancy by a loop over points: lower faces included, and the upper face of the last cell too."""
    occupied = np.zeros((side, side, side))
    for point in cloud:
        place = [math.floor((x + 1) / 2 * side) for x in point]
        if all(-1 <= x <= 1 for x in point):
            occupied[tuple(min(axis, side - 1) for axis in place)] = 1
    return occupied


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("side", [1, 2, 7, 32])
@pytest.mark.parametrize("normalise", ["unit_ball", "robust"])
def test_agrees_with_a_loop(normalise, side, dtype):
    lengths = [200, 1, 30]
    clouds = batch_of(lengths, 5, dtype)
    features = grids_of(build_encoder((200, 5), side=side, normalise=normalise), clouds, side)
    local = normalise_clouds(clouds, normalise).clouds[..., :3].double().numpy()
    for number, length in enumerate(lengths):
        np.testing.assert_array_equal(features[number, 0].numpy(), by_hand(local[number, :length], side))


coordinate = st.floats(-1, 1, width=32) | st.sampled_from([-1.0, -0.5, 0.0, 0.5, 1.0])


@given(
    st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=20),
    st.integers(1, 9),
    st.sampled_from([1e-8, 1.0, 1e8]),
)
@settings(max_examples=100, deadline=None)
def test_wild_clouds_occupy_as_many_cells_as_points_at_most(points, side, scale):
    clouds = torch.tensor(points)[None] * scale
    occupied = build_encoder(side=side)(clouds)
    assert set(occupied.unique().tolist()) <= {0.0, 1.0}
    assert 1 <= occupied.sum() <= min(len(points), side**3)
    np.testing.assert_array_equal(
        occupancy(torch.tensor(points)[None], side).reshape(side, side, side).numpy(), by_hand(points, side)
    )


def test_points_at_the_edge_are_in_and_beyond_it_out():
    clouds = torch.tensor([[[1.0, 1, 1], [-1, -1, -1], [1 + 6e-8, 0, 0], [1.1, 0, 0], [0, 0, -1.1]]])
    occupied = occupancy(clouds, 2).reshape(2, 2, 2)
    assert occupied.tolist() == [[[1, 0], [0, 0]], [[0, 0], [0, 1]]]


@pytest.mark.parametrize("dtype", DTYPES)
def test_cells_lead_back_to_within_half_their_diagonal(dtype):
    lengths, side = [200, 3], 16
    clouds = batch_of(lengths, dtype=dtype)
    local = normalise_clouds(clouds, "unit_ball")
    occupied = occupancy(local.clouds, side)
    back = decode(occupied, side, local)
    assert back.dtype == dtype
    counts = sizes(back)
    for number, length in enumerate(lengths):
        assert counts[number] == occupied[number].sum()
        cloud, cells = clouds[number, :length].numpy(), back[number, : counts[number]].numpy()
        distance = np.linalg.norm(cloud[:, None] - cells, axis=-1)
        limit = math.sqrt(3) / side * local.scale[number].item() * (1 + 1e-6)
        assert distance.min(0).max() <= limit  # every cell has a point,
        assert distance.min(1).max() <= limit  # every point a cell


@pytest.mark.parametrize("config", [{"side": 0}, {"side": 1000}, {"normalise": "ball"}])
def test_a_config_out_of_range_is_refused(config):
    with pytest.raises(ConfigError, match=r"encoder\."):
        build_encoder(**config)
