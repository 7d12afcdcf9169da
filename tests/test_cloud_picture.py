"""Small pictures of point clouds."""

import math

import numpy as np
import pytest
import torch

from framework.datasets import cloud_picture
from framework.geometry.mesh_files import COLOURS


def test_the_picture_shows_the_nearer_of_two_points_and_its_colour():
    # one behind the other on the line of sight, towards the viewer: red in front of blue
    a, e = cloud_picture.AZIMUTH, cloud_picture.ELEVATION
    towards = torch.tensor([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    aside = torch.tensor([-math.sin(a), math.cos(a), 0.0])
    places = torch.stack([towards, -towards, 3 * aside, -3 * aside])
    colours = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, 1, 0], [0, 1, 0]])
    for order in ([0, 1, 2, 3], [1, 0, 3, 2]):
        cloud = torch.cat([places, colours], 1)[order]
        image = cloud_picture.draw_cloud(cloud, ("x", "y", "z", *COLOURS), side=101)
        assert image.shape == (101, 101, 3)
        red, blue = ((image == colour).all(-1) for colour in ([255, 0, 0], [0, 0, 153]))
        assert red[47:54, 47:54].sum() == red.sum() == 21  # the whole disc
        assert blue.sum() <= 7  # of another pixel's width at the rim, by rounding
        assert (image == [255, 255, 255]).all(-1).mean() > 0.8


def test_up_is_up_and_the_padding_is_not_seen():
    stick = torch.stack([torch.zeros(200), torch.zeros(200), torch.linspace(0, 1, 200)], 1)
    cap = torch.tensor([[0.2, 0, 1.0], [-0.2, 0, 1.0]]).repeat(20, 1)
    cloud = torch.cat([stick, cap])
    image = cloud_picture.draw_cloud(cloud)
    dark = (image < 255).any(-1)
    assert dark[:40].sum() > dark[-40:].sum()
    padded = torch.cat([cloud, torch.full((500, 3), math.nan)])
    np.testing.assert_array_equal(cloud_picture.draw_cloud(padded), image)


@pytest.mark.parametrize(
    "cloud",
    [
        torch.zeros(0, 3),
        torch.ones(1, 3),
        torch.full((4, 3), math.nan),
        torch.ones(3, 3) * 1e30,
        torch.eye(3) * 1e-30,
    ],
)
def test_any_cloud_has_a_picture(cloud):
    assert cloud_picture.draw_cloud(cloud).dtype == np.uint8
