import pytest
import torch

from framework.configuration.schema import build, resolve
from plugins.encoder.point_sets.pointnet import PointNet
from plugins.encoder.point_sets.test_pointnet2 import apply_layers, read_points, readings, require_agreement

SMALL = {"point_widths": [8, 10, 8, 12], "widths": [12, 8], "dropout": 0.0}


def build_encoder(shape=(50, 3), **config):
    torch.manual_seed(0)
    encoder = build("encoder", resolve("encoder", {"name": "pointnet", **SMALL, **config}), input_shape=shape)
    encoder(torch.randn(12, *shape))  # moves the running moments away from their initial values
    return encoder.eval()


def matrix(network, points):
    entries = apply_layers(network.whole, apply_layers(network.each, points).max(0))
    entries = network.entries.weight.detach().double().numpy() @ entries
    return (entries + network.entries.bias.detach().double().numpy()).reshape(network.size, network.size)


def by_hand(encoder, cloud):
    """Return the features of one cloud (points, columns) in NumPy, float64."""
    points = read_points(encoder, cloud)
    if encoder.input_matrix is not None:
        points[:, :3] = points[:, :3] @ matrix(encoder.input_matrix, points[:, :3])
    points = apply_layers(encoder.local, points)
    if encoder.feature_matrix is not None:
        points = points @ matrix(encoder.feature_matrix, points)
    return apply_layers(encoder.whole, apply_layers(encoder.deep, points).max(0))


@pytest.mark.parametrize("variant", ["full", "vanilla"])
@pytest.mark.parametrize("columns, config", readings(points=20), ids=str)
def test_agrees_with_numpy_on_clouds_of_any_size(variant, columns, config):
    encoder = build_encoder((50, columns), variant=variant, **config)
    clouds = [torch.randn(number, columns) * 4 + 7 for number in (50, 1, 13, 30)]
    require_agreement(encoder, clouds, by_hand)


def test_it_is_the_published_network():
    for variant, wanted in (("vanilla", 0.8e6), ("full", 3.5e6)):
        encoder = PointNet((1024, 3), variant=variant)
        count = sum(parameter.numel() for parameter in encoder.parameters()) + 257 * 40
        assert count == pytest.approx(wanted, rel=0.025)  # Qi et al. 2017, Table 6
    assert encoder.output_shape == (256,)


def test_matrices_begin_near_the_identity():
    encoder = PointNet((30, 3)).eval()
    points, counts = torch.randn(60, 3), torch.tensor([30, 30])
    matrices = encoder.input_matrix(points, counts)
    torch.testing.assert_close(matrices, torch.eye(3).expand(2, 3, 3), rtol=0, atol=0.05)
    assert not torch.equal(matrices[0], matrices[1])
