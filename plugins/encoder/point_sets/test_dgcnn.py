"""Tests of DGCNN against loops over points and edges in NumPy."""

import copy
import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from framework.configuration.schema import build, resolve
from framework.geometry.clouds import pad
from plugins.encoder.point_sets.dgcnn import DGCNN, edge_convolution
from plugins.encoder.point_sets.layers import layers
from plugins.encoder.point_sets.neighbours import nearest_rows
from plugins.encoder.point_sets.test_pointnet2 import apply_layers, read_points, readings, require_agreement

SMALL = {"neighbours": 5, "edge_widths": [8, 6, 10], "point_width": 12, "widths": [12, 8], "dropout": 0.0}


def build_encoder(shape=(50, 3), **config):
    torch.manual_seed(0)
    encoder = build("encoder", resolve("encoder", {"name": "dgcnn", **SMALL, **config}), input_shape=shape)
    for module in encoder.modules():
        if isinstance(module, torch.nn.BatchNorm1d):  # factors of both signs
            torch.nn.init.normal_(module.weight)
            torch.nn.init.normal_(module.bias)
    encoder(torch.randn(12, *shape))  # moves the running moments away from their initial values
    return encoder.eval()


def nearest(places, number):
    """Return the indices of the nearest points of each point, from all distances."""
    distance = np.linalg.norm(places[:, None] - places, axis=-1)
    return np.argsort(distance, axis=1)[:, :number]


def by_hand(encoder, cloud):
    """Return the features of one cloud (points, columns) edge by edge in NumPy, float64."""
    values = read_points(encoder, cloud)
    places, outputs = values[:, :3], []
    activation = torch.nn.LeakyReLU(0.2)
    for network in encoder.edges:
        values = np.stack(
            [
                np.max(
                    [
                        apply_layers([*network, activation], np.hstack([values[j] - values[i], values[i]]))
                        for j in near
                    ],
                    0,
                )
                for i, near in enumerate(nearest(places, encoder.neighbours))
            ]
        )
        places = values
        outputs.append(values)
    each = apply_layers(encoder.each, np.hstack(outputs))
    return apply_layers(encoder.last, np.concatenate([each.max(0), each.mean(0)]))


@pytest.mark.parametrize("columns, config", readings(points=20), ids=str)
def test_agrees_with_numpy_on_clouds_of_any_size(columns, config):
    encoder = build_encoder((50, columns), **config)
    clouds = [torch.randn(number, columns) * 4 + 7 for number in (50, 2, 3, 13, 30)]
    require_agreement(encoder, clouds, by_hand)


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize(
    "dtype, near",
    [(torch.float64, {"rtol": 1e-9, "atol": 1e-10}), (torch.float32, {"rtol": 1e-3, "atol": 1e-5})],
    ids=str,
)
def test_value_gradients_and_moments_are_those_of_all_edges(training, dtype, near):
    """Compare with layers that read the vector of each edge."""
    torch.manual_seed(0)
    network = layers(8, [6], 0.2).to(dtype).train(training)
    torch.nn.init.normal_(network[1].weight)
    torch.nn.init.normal_(network[1].bias)
    points, index = torch.randn(30, 4, dtype=dtype), torch.randint(30, (30, 5))
    results = []
    for by_edges in (True, False):
        copied, values = copy.deepcopy(network), points.clone().requires_grad_()
        if by_edges:
            own = values.unsqueeze(1).expand(-1, 5, -1)
            edges = torch.cat([values[index] - own, own], -1).flatten(0, 1)
            outputs = copied(edges).unflatten(0, (30, 5)).amax(1)
        else:
            outputs = edge_convolution(copied[:2], values, index)
        outputs.square().sum().backward()
        gradients = [parameter.grad for parameter in copied.parameters()]
        results.append([outputs.detach(), values.grad, *gradients, *copied.buffers()])
    for mine, every in zip(*results, strict=True):
        torch.testing.assert_close(mine, every, **near)


def test_the_gradient_is_that_of_differences():
    encoder = build_encoder((12, 4), attributes=True).double()
    padding = torch.full((5, 4), math.nan, dtype=torch.float64)

    def features(values):
        return encoder(torch.stack([values[:12], torch.cat([values[12:], padding])]))

    rows = torch.randn(19, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(features, (rows,), eps=1e-6, atol=1e-6, fast_mode=True)


def test_order_place_size_and_company_of_a_cloud_change_nothing():
    encoder = build_encoder((150, 3)).double()
    clouds = [torch.randn(number, 3, dtype=torch.float64) for number in (150, 40, 3, 1)]
    wanted = encoder(pad(clouds))
    for index, cloud in enumerate(clouds):
        turned = cloud[torch.randperm(len(cloud))]
        for changed in (turned, cloud + 100, cloud * 3, torch.cat([cloud, cloud.new_full((9, 3), math.nan)])):
            torch.testing.assert_close(encoder(changed[None])[0], wanted[index], rtol=1e-9, atol=1e-9)


def test_points_in_one_place_and_one_point_alone_are_the_same_cloud():
    encoder = build_encoder()
    features = encoder(torch.full((1, 50, 3), 4.0))
    assert torch.isfinite(features).all()
    torch.testing.assert_close(features, encoder(torch.zeros(1, 1, 3)), rtol=1e-5, atol=1e-6)


def test_mixed_precision_finds_the_same_neighbours(monkeypatch):
    searches = []

    def recorded(*arguments):
        searches.append(nearest_rows(*arguments))
        return searches[-1]

    monkeypatch.setattr("plugins.encoder.point_sets.dgcnn.nearest_rows", recorded)
    encoder, clouds = build_encoder(edge_widths=[8]), torch.randn(2, 50, 3)
    searches.clear()
    full = encoder(clouds)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = encoder(clouds)
    assert torch.equal(*searches)
    torch.testing.assert_close(mixed.float(), full, rtol=0.1, atol=0.1)


def test_it_is_the_published_network():
    encoder = DGCNN((1024, 3)).eval()
    count = sum(parameter.numel() for parameter in encoder.parameters()) + 257 * 40
    assert count == 1_809_320  # 1.81 million in the authors' code, which has 256 needless biases more
    assert encoder.output_shape == (256,)


def test_flops_are_those_of_distances_and_products_of_points():
    encoder = build_encoder((30, 3)).eval()
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        encoder(torch.randn(1, 30, 3))
    widths = [3, 8, 6, 10]
    distances = sum(30 * 30 * before for before in widths[:-1])
    edges = sum(30 * 2 * before * after for before, after in pairwise(widths))
    rest = 30 * (8 + 6 + 10) * 12 + 24 * 12 + 12 * 8
    assert counter.get_total_flops() == 2 * (distances + edges + rest)
