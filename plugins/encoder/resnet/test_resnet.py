"""Tests against torchvision's networks, with weights that depend only on their names and shapes."""

import numpy as np
import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.errors import CheckpointError, ConfigError
from framework.testing.named_weights import hash_names_and_shapes, weights_of_names

NAMES = {
    18: "504739f3083bec5ee0755e2a89f10f73ea11987f4523e1732347283251361313",
    34: "44a0fd3c2ef0c9ed6b3728fcbd3cf972f7f37fb30d16328203db128a281b9f9a",
    50: "c1f7fd3808aa49e7afb0ec26ebebafda398d447a68e9547c34a3d6fc8945c74c",
    101: "a36254db3e8fffb450c31dd6b494ba0ab8b688950ec8119a20d04d4406f2c20d",
}
"""SHA-256 of names and shapes of torchvision 0.28's weights without fc.*."""
PARAMETERS = {18: 11_689_512, 34: 21_797_672, 50: 25_557_032, 101: 44_549_160}
"""Number of parameters with a classifier of 1000 classes, as torchvision states it."""
FEATURES = {
    18: (
        48.13312548489285,
        43.09075075037137,
        [75.12104839263, 166.1798482142, 102.8181535606, 13.7393531123],
    ),
    50: (
        2608.283186732858,
        2343.854107716,
        [3316.7428191543, 3035.5406458250, 345.5347022303, 1692.6446210317],
    ),
}
"""Mean, deviation and four features of the first image, of torchvision 0.28 with `weights_of_names` in float64."""


def encoder(size=(3, 70, 45), **config):
    torch.manual_seed(5)
    return build("encoder", resolve("encoder", {"name": "resnet", **config}), input_shape=size)


@pytest.mark.parametrize("depth", [18, 34, 50, 101])
def test_names_shapes_and_number_of_weights_are_torchvisions(depth):
    network = encoder(depth=depth)
    assert hash_names_and_shapes(network.state_dict()) == NAMES[depth]
    classifier = 1000 * (network.output_shape[0] + 1)
    assert sum(parameter.numel() for parameter in network.parameters()) + classifier == PARAMETERS[depth]


@pytest.mark.parametrize("depth", FEATURES)
@pytest.mark.parametrize("frozen", [False, True])
def test_features_are_torchvisions_from_a_weight_file(depth, frozen, tmp_path):
    file = tmp_path / "weights.pth"
    weights = weights_of_names(encoder(depth=depth).state_dict())
    torch.save(weights | {"fc.weight": torch.zeros(1000, 512), "fc.bias": torch.zeros(1000)}, file)
    network = encoder(depth=depth, weights=str(file), frozen=frozen)
    images = torch.tensor(np.random.default_rng(1).uniform(size=(2, 3, 70, 45)), dtype=torch.float32)
    mean, deviation, features = FEATURES[depth]
    with torch.no_grad():
        result = (network.train() if frozen else network.eval())(images).double()
    assert result.mean().item() == pytest.approx(mean, rel=1e-5)
    assert result.std().item() == pytest.approx(deviation, rel=1e-5)
    np.testing.assert_allclose(result[0, :: result.shape[1] // 4], features, rtol=1e-4)


def test_a_frozen_network_learns_nothing():
    network = encoder((3, 32, 32), frozen=True)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    network.train()(torch.rand(4, 3, 32, 32))
    assert network.fixed and not any(parameter.requires_grad for parameter in network.parameters())
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


def test_what_cannot_be_read_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="reads images"):
        encoder((16,))
    with pytest.raises(ConfigError, match="at least 32 × 32"):
        encoder((3, 31, 64))
    torch.save(weights_of_names(encoder(depth=34).state_dict()), tmp_path / "deep.pth")
    with pytest.raises(CheckpointError, match=r"does not fit ResNet: .*layer"):
        encoder(depth=18, weights=str(tmp_path / "deep.pth"))
