"""Tests of the properties that occupancy and truncated distances have in common."""

import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.errors import DataError
from framework.geometry.clouds import normalise_clouds
from plugins.encoder.grids import occupancy, tdf

NAMES = ("occupancy", "tdf")


def build_encoder(name, **config):
    return build("encoder", resolve("encoder", {"name": name, **config}), input_shape=(40, 3))


@pytest.mark.parametrize("name", NAMES)
def test_the_features_are_fixed_and_nothing_is_learned(name):
    encoder = build_encoder(name, side=8)
    assert encoder.fixed
    assert not encoder.state_dict()
    assert encoder(torch.zeros(0, 40, 3)).shape == encoder(torch.zeros(0, 0, 3)).shape == (0, 1, 8, 8, 8)


@pytest.mark.parametrize("name", NAMES)
def test_clouds_that_were_not_normalised_are_refused_by_none(name):
    with pytest.raises(
        DataError, match=rf"Cloud 0 of the batch extends to .* encoder {name} with normalise=none"
    ):
        build_encoder(name, normalise="none")(1e9 * torch.randn(2, 5, 3, dtype=torch.float64))


@pytest.mark.parametrize(
    "numbers, decode, nothing, words",
    [
        (occupancy.occupancy, occupancy.decode, 0, "is occupied"),
        (lambda clouds, side: tdf.truncated_distance(clouds, side, 1.0), tdf.decode, 1, "is near a point"),
    ],
    ids=NAMES,
)
def test_a_cloud_outside_the_cube_does_not_lead_back(numbers, decode, nothing, words):
    far = torch.full((1, 4, 3), 5.0)
    cells = numbers(far, 4)
    assert (cells == nothing).all()
    with pytest.raises(DataError, match=f"No cell of cloud 0 {words}"):
        decode(cells, 4, normalise_clouds(far, "none"))
