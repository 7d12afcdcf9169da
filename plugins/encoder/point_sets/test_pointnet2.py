import itertools
import math
from functools import partial

import numpy as np
import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.errors import DataError
from framework.geometry.clouds import pad
from plugins.encoder.point_sets.pointnet2 import PointNet2

SMALL = {"width": 0.125, "centroids": [20, 6], "radius": 0.4, "dropout": 0.0}
BALLS = {  # radius, neighbours of each scale of each level, in SMALL's units; Qi et al. 2017 with 0.2 as 0.4
    "single_scale": [[(0.4, 32)], [(0.8, 64)]],
    "multi_scale": [[(0.2, 16), (0.4, 32), (0.8, 128)], [(0.4, 32), (0.8, 64), (1.6, 128)]],
}


def build_encoder(shape=(150, 3), **config):
    torch.manual_seed(0)
    encoder = build(
        "encoder", resolve("encoder", {"name": "pointnet2", **SMALL, **config}), input_shape=shape
    )
    encoder(torch.randn(6, *shape) / 3)  # moves the running moments away from their initial values
    return encoder.eval()


def apply_layers(layers, numbers):
    """Return numbers after linear layers, batch norm with the running moments, and (leaky) ReLU, in NumPy."""
    for layer in layers:
        state = {name: value.double().numpy() for name, value in layer.state_dict().items()}
        if isinstance(layer, torch.nn.Linear):
            numbers = numbers @ state["weight"].T
        elif isinstance(layer, torch.nn.BatchNorm1d):
            numbers = (numbers - state["running_mean"]) / np.sqrt(state["running_var"] + 1e-5)
            numbers = numbers * state["weight"] + state["bias"]
        elif isinstance(layer, torch.nn.ReLU):
            numbers = np.maximum(numbers, 0)
        elif isinstance(layer, torch.nn.LeakyReLU):
            numbers = np.where(numbers > 0, numbers, layer.negative_slope * numbers)
    return numbers


def read_points(encoder, cloud):
    """Return the points of a cloud that an encoder reads, in NumPy, float64, normalised as eq. 6.2."""
    points = cloud.double().numpy().copy()
    points[:, :3] -= points[:, :3].mean(0)
    points[:, :3] /= np.sqrt((points[:, :3] ** 2).sum(1)).max()
    return points[: encoder.reading.points, : encoder.columns]


def readings(points):
    """Return the columns of clouds and the settings of what is read: coordinates, attributes, and the first points."""
    return [(3, {}), (6, {}), (6, {"attributes": True}), (3, {"points": points})]


def require_agreement(encoder, clouds, by_hand):
    """Require that an encoder returns what the function `by_hand` computes from each cloud of two or more points."""
    rows = [row for row, cloud in enumerate(clouds) if len(cloud) > 1]
    wanted = np.stack([by_hand(encoder.double(), clouds[row]) for row in rows])
    features = encoder(pad(clouds).double()).detach().numpy()
    assert np.isfinite(features).all()
    np.testing.assert_allclose(features[rows], wanted, rtol=1e-9, atol=1e-9)
    single = encoder.float()(pad(clouds)).detach().numpy()[rows]
    np.testing.assert_allclose(single, wanted, rtol=1e-4, atol=1e-5)


def order_by_distance(places, start):
    """Return an order in which each point is as far as possible from those before it, from all distances."""
    order = [start]
    while len(order) < len(places):
        distance = np.linalg.norm(places[:, None] - places[order], axis=-1).min(1)
        distance[order] = -1
        order.append(int(distance.argmax()))
    return order


def by_hand(encoder, cloud, balls):
    """Return the features of one cloud (points, columns) ball by ball in NumPy, float64."""
    points = read_points(encoder, cloud)
    mean = points[:, :3].mean(0)
    points = points[
        order_by_distance(points[:, :3], int(np.linalg.norm(points[:, :3] - mean, axis=1).argmax()))
    ]
    for level, scales in zip(encoder.levels, balls, strict=True):
        points = points[order_by_distance(points[:, :3], 0)]
        places, described = points[:, :3], []
        for centre in places[: level.centroids]:
            numbers = []
            for network, (radius, most) in zip(level.networks, scales, strict=True):
                near = points[np.linalg.norm(places - centre, axis=1) <= radius][:most]
                numbers.append(apply_layers(network, np.hstack([near[:, :3] - centre, near[:, 3:]])).max(0))
            described.append(np.concatenate([centre, *numbers]))
        points = np.stack(described)
    return apply_layers(encoder.last, apply_layers(encoder.whole, points).max(0))


@pytest.mark.parametrize("grouping", ["single_scale", "multi_scale"])
@pytest.mark.parametrize("columns, config", readings(points=40), ids=str)
def test_agrees_with_numpy_on_clouds_of_any_size(grouping, columns, config):
    encoder = build_encoder((150, columns), grouping=grouping, **config)
    clouds = [torch.randn(number, columns) * 4 + 7 for number in (150, 2, 13, 30)]
    require_agreement(encoder, clouds, partial(by_hand, balls=BALLS[grouping]))


@pytest.mark.parametrize(
    "grouping, chains, total, megabytes",
    [
        (
            "single_scale",
            [(3, 64, 64, 128), (131, 128, 128, 256), (259, 256, 512, 1024), (1024, 512, 256)],
            1_472_360,
            5.9,
        ),
        (
            "multi_scale",
            [
                *[(3, 32, 32, 64), (3, 64, 64, 128), (3, 64, 96, 128)],
                *[(323, 64, 64, 128), (323, 128, 128, 256), (323, 128, 128, 256)],
                *[(643, 256, 512, 1024), (1024, 512, 256)],
            ],
            1_742_856,  # 1.7e6, Table 6.2
            7.0,
        ),
    ],
)
def test_parameters_of_the_published_networks(grouping, chains, total, megabytes):
    """Check that "multi_scale" has the parameters of Table 6.2; the 5.8 MB of Table 6.3 are nearer "single_scale"."""
    encoder = PointNet2((1024, 3), grouping=grouping)
    weights = sum(before * after for chain in chains for before, after in itertools.pairwise(chain))
    moments = sum(sum(chain[1:]) for chain in chains)
    assert weights + 2 * moments + 257 * 40 == total
    assert sum(parameter.numel() for parameter in encoder.parameters()) + 257 * 40 == total
    stored = sum(tensor.numel() * tensor.element_size() for tensor in encoder.state_dict().values())
    assert (stored + 4 * 257 * 40) / 1e6 == pytest.approx(megabytes, abs=0.05)
    assert encoder.output_shape == (256,)


@pytest.mark.parametrize("grouping", ["single_scale", "multi_scale"])
def test_the_gradient_is_that_of_differences(grouping):
    encoder = build_encoder((12, 4), grouping=grouping, attributes=True, width=0.03).double()
    clouds = pad([torch.randn(12, 4), torch.randn(7, 4)]).double()
    clouds[1, 7:] = math.nan
    rows = [torch.cat([clouds[0], clouds[1, :7]]).requires_grad_()]

    def features(values):
        padding = values.new_full((5, 4), math.nan)
        return encoder(torch.stack([values[:12], torch.cat([values[12:], padding])]))

    assert torch.autograd.gradcheck(features, rows, eps=1e-6, atol=1e-6, fast_mode=True)


@pytest.mark.parametrize("grouping", ["single_scale", "multi_scale"])
def test_order_place_size_and_company_of_a_cloud_change_nothing(grouping):
    encoder = build_encoder(grouping=grouping).double()
    clouds = [torch.randn(number, 3, dtype=torch.float64) for number in (150, 40, 3)]
    wanted = encoder(pad(clouds))
    for index, cloud in enumerate(clouds):
        turned = cloud[torch.randperm(len(cloud))]
        for changed in (turned, cloud + 100, cloud * 3, torch.cat([cloud, cloud.new_full((9, 3), math.nan)])):
            torch.testing.assert_close(encoder(changed[None])[0], wanted[index], rtol=1e-9, atol=1e-9)
        assert torch.equal(encoder(cloud[None]), encoder(cloud[None]))


@pytest.mark.parametrize("grouping", ["single_scale", "multi_scale"])
def test_of_a_lattice_the_order_decides_and_padding_does_not(grouping):
    encoder = build_encoder(grouping=grouping).double()
    axis = torch.arange(5, dtype=torch.float64)
    cloud = torch.cartesian_prod(axis, axis, axis)
    wanted = encoder(cloud[None])
    padded = torch.cat([cloud, cloud.new_full((9, 3), math.nan)])
    torch.testing.assert_close(encoder(padded[None]), wanted, rtol=1e-9, atol=1e-9)
    assert (encoder(cloud.flip(0)[None]) - wanted).abs().max() > 1e-6  # as the docstring says


@pytest.mark.parametrize("grouping", ["single_scale", "multi_scale"])
@pytest.mark.parametrize("number", [5, 19, 150])
def test_points_that_all_come_twice_change_nothing(grouping, number):
    """Check duplicated points, which come last in the order and only replace repetitions of a ball's first point."""
    encoder = build_encoder((300, 3), grouping=grouping).double()
    cloud = torch.randn(number, 3, dtype=torch.float64)
    twice = torch.cat([cloud, cloud[torch.randperm(number)]])
    torch.testing.assert_close(encoder(twice[None]), encoder(cloud[None]), rtol=1e-9, atol=1e-9)


def test_points_in_one_place_and_one_point_alone_are_the_same_cloud():
    encoder = build_encoder()
    features = encoder(torch.full((1, 150, 3), 4.0))
    assert torch.isfinite(features).all()
    torch.testing.assert_close(features, encoder(torch.zeros(1, 1, 3)))


def test_refuses_clouds_for_which_its_balls_mean_nothing():
    encoder = build_encoder(normalise="none", radius=0.2)
    clouds = torch.randn(3, 150, 3) / 3
    assert torch.isfinite(encoder(clouds)).all()
    clouds[1] *= 100
    with pytest.raises(DataError, match=r"Cloud 1 of the batch extends to .* encoder pointnet2"):
        encoder(clouds)
