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
from plugins.encoder.grids.tdf import decode, truncated_distance
from plugins.encoder.grids.test_occupancy import grids_of

DTYPES = [torch.float32, torch.float64]


def build_encoder(shape=(40, 3), **config):
    return build("encoder", resolve("encoder", {"name": "tdf", **config}), input_shape=shape)


def by_hand(cloud, side, truncation):
    """Return every cell's truncated distance from the points, by all pairs (§6.5.1)."""
    limit = truncation * 2 / side
    axis = [-1 + (2 * number + 1) / side for number in range(side)]
    centres = np.array([[x, y, z] for x in axis for y in axis for z in axis])
    distance = np.sqrt(((centres[:, None] - cloud) ** 2).sum(-1)).min(1)
    return np.minimum(distance, limit) / limit


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    "side, truncation", [(1, 1.0), (8, 0.3), (8, 0.5), (8, 1.0), (9, 1.7), (6, 4.0), (32, 1.0)]
)
def test_agrees_with_a_loop(side, truncation, dtype):
    lengths = [100, 1, 30]
    clouds = batch_of(lengths, 5, dtype)
    features = grids_of(build_encoder((100, 5), side=side, truncation=truncation), clouds, side)
    local = normalise_clouds(clouds, "unit_ball").clouds[..., :3].double().numpy()
    for number, length in enumerate(lengths):
        wanted = by_hand(local[number, :length], side, truncation)
        limit = (
            1e-5 if dtype == torch.float32 else 1e-12
        )  # as a share of the truncation, which is many cells wide
        np.testing.assert_allclose(features[number].flatten().numpy(), wanted, rtol=0, atol=limit)


coordinate = st.floats(-1.5, 1.5, width=32) | st.sampled_from([-1.0, -0.5, 0.0, 0.5, 1.0, 1e6])


@given(
    st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=20),
    st.integers(1, 9),
    st.floats(0.1, 4),
)
@settings(max_examples=100, deadline=None)
def test_wild_points_also_outside_of_the_cube(points, side, truncation):
    cloud = torch.tensor(points, dtype=torch.float64)
    features = truncated_distance(cloud[None], side, truncation)[0].numpy()
    np.testing.assert_allclose(features, by_hand(cloud.numpy(), side, truncation), rtol=0, atol=1e-7)


def test_the_gradient_agrees_with_finite_differences_and_is_finite_at_a_centre():
    clouds = batch_of([7, 7]).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda clouds: build_encoder(side=4, truncation=1.5)(clouds), (clouds,), eps=1e-6, atol=1e-6
    )
    centre = torch.zeros(1, 1, 3, requires_grad=True)
    truncated_distance(centre, 1, 1.0).sum().backward()
    assert centre.grad is not None
    assert centre.grad.isfinite().all()


def test_cells_lead_back_to_within_the_truncation():
    lengths, side = [200, 3], 16
    clouds = batch_of(lengths)
    local = normalise_clouds(clouds, "unit_ball")
    field = truncated_distance(local.clouds, side, 1.0)
    back = decode(field, side, local)
    counts = sizes(back)
    for number, length in enumerate(lengths):
        assert counts[number] == (field[number] < 1).sum()
        cloud, cells = clouds[number, :length].numpy(), back[number, : counts[number]].numpy()
        distance = np.linalg.norm(cloud[:, None] - cells, axis=-1)
        edge = 2 / side * local.scale[number].item()
        assert distance.min(0).max() <= edge * (1 + 1e-9)
        assert distance.min(1).max() <= edge * math.sqrt(3) / 2 * (1 + 1e-9)  # its own cell is among them


@pytest.mark.parametrize(
    "config",
    [{"side": 0}, {"truncation": 0}, {"truncation": 5}, {"truncation": math.nan}, {"normalise": "ball"}],
)
def test_a_config_out_of_range_is_refused(config):
    with pytest.raises(ConfigError, match=r"encoder\."):
        build_encoder(**config)
