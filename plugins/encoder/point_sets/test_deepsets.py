import numpy as np
import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.geometry.clouds import pad
from plugins.encoder.point_sets.deepsets import DeepSets, below_largest
from plugins.encoder.point_sets.test_pointnet2 import read_points, readings

SMALL = {"channels": [8, 10, 12], "widths": [12, 8]}


def build_encoder(shape=(50, 3), **config):
    torch.manual_seed(0)
    return build(
        "encoder", resolve("encoder", {"name": "deepsets", **SMALL, **config}), input_shape=shape
    ).eval()


def by_hand(encoder, cloud, activation):
    """Return the features of one cloud (points, columns) by loops in NumPy, float64."""
    points = read_points(encoder, cloud)
    for layer in encoder.equivariant:
        weight, bias = layer.weight.detach().double().numpy(), layer.bias.detach().double().numpy()
        most = points.max(0)
        points = np.stack([activation(weight @ (point - most) + bias) for point in points])
    numbers = points.max(0)
    for layer in encoder.whole:
        if isinstance(layer, torch.nn.Linear):
            weight, bias = layer.weight.detach().double().numpy(), layer.bias.detach().double().numpy()
            numbers = activation(weight @ numbers + bias)
    return numbers


@pytest.mark.parametrize(
    "name, activation", [("tanh", np.tanh), ("elu", lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))))]
)
@pytest.mark.parametrize("columns, config", readings(points=20), ids=str)
def test_agrees_with_numpy_on_clouds_of_any_size(name, activation, columns, config):
    encoder = build_encoder((50, columns), activation=name, **config)
    clouds = [torch.randn(number, columns) * 4 + 7 for number in (50, 2, 13, 30)]
    wanted = np.stack([by_hand(encoder, cloud, activation) for cloud in clouds])
    features = encoder.double()(pad(clouds).double()).detach().numpy()
    np.testing.assert_allclose(features, wanted, rtol=1e-10, atol=1e-10)
    single = encoder.float()(pad(clouds)).detach().numpy()
    np.testing.assert_allclose(single, wanted, rtol=1e-4, atol=1e-5)


def test_a_layer_commutes_with_any_reordering():
    encoder = build_encoder().double()
    points, counts = torch.randn(30, 3, dtype=torch.float64), torch.tensor([30])
    order = torch.randperm(30)
    first = encoder.equivariant[0](below_largest(points, counts))
    torch.testing.assert_close(encoder.equivariant[0](below_largest(points[order], counts)), first[order])


def test_what_all_points_share_is_not_seen():
    encoder = build_encoder(normalise="none").double()
    cloud = torch.randn(1, 30, 3, dtype=torch.float64)
    torch.testing.assert_close(
        encoder(cloud + torch.tensor([5.0, -3.0, 1.0])), encoder(cloud), rtol=1e-9, atol=1e-9
    )


def test_it_is_the_published_network():
    count = sum(parameter.numel() for parameter in DeepSets((5000, 3)).parameters()) + 257 * 40
    assert count == (4 * 256 + 3 * 257 * 256) + 257 * 40
    assert count == pytest.approx(2.1e5, rel=0.01)  # thesis Table 6.2
