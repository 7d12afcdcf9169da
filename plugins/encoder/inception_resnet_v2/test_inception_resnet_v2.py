import numpy as np
import pytest
import torch
from torch import nn

from framework.configuration.schema import build, resolve
from framework.errors import CheckpointError, ConfigError
from framework.testing.named_weights import hash_names_and_shapes, weights_of_names
from plugins.encoder.inception_resnet_v2.encoder import InceptionResNetV2
from plugins.encoder.inception_resnet_v2.layers import ConvNorm, Residual, mixed_5b


@pytest.fixture(scope="module")
def encoder():
    """Return one encoder for all tests that change nothing: building it takes a second."""
    torch.manual_seed(0)
    return build("encoder", resolve("encoder", "inception_resnet_v2"), input_shape=(3, 107, 75)).eval()


def test_names_and_shapes_are_timms(encoder):
    # computed from timm 1.0.31's inception_resnet_v2 without classif.*
    assert (
        hash_names_and_shapes(encoder.state_dict())
        == "b89cce2f5e335169473effef31dffea2f11dc7e368e9a39fe5b6b8c2eef27b5f"
    )


def test_parameters_are_as_published(encoder):
    backbone = sum(parameter.numel() for parameter in encoder.parameters())
    assert backbone == 54_306_464
    assert backbone + 1536 * 1000 + 1000 == 55_843_464  # timm's, with its classifier of 1000 classes
    assert encoder.output_shape == (1536,)


def test_features_are_timms_from_a_weight_file(encoder, tmp_path):
    file = tmp_path / "weights.pth"
    weights = weights_of_names(encoder.state_dict()) | {
        "classif.weight": torch.zeros(1000, 1536),
        "classif.bias": torch.zeros(1000),
    }
    torch.save(weights, file)
    config = resolve("encoder", {"name": "inception_resnet_v2", "weights": str(file)})
    images = torch.tensor(np.random.default_rng(1).uniform(size=(2, 3, 107, 75)), dtype=torch.float32)
    with torch.no_grad():
        features = build("encoder", config, input_shape=(3, 107, 75)).eval()(images)
    assert features.shape == (2, 1536)
    assert features.dtype == torch.float32
    # timm 1.0.31, forward_features(2 x - 1).mean((2, 3)) with the same weights in float64
    assert features.double().mean().item() == pytest.approx(4.572326056955698, rel=1e-5)
    assert features.double().std().item() == pytest.approx(7.109568968236445, rel=1e-5)
    expected = [[0, 5.778700616481, 0, 0.214286141430], [0, 5.473244922087, 0, 0.336070947979]]
    np.testing.assert_allclose(features[:, ::400].numpy(), expected, rtol=1e-4, atol=1e-5)


def test_a_grey_image_is_read_as_three_equal_channels(encoder):
    torch.manual_seed(1)
    pixels = torch.randint(0, 256, (1, 1, 80, 75), dtype=torch.uint8)
    with torch.no_grad():
        torch.testing.assert_close(encoder(pixels), encoder(pixels.expand(-1, 3, -1, -1)))


def test_a_residual_block_is_its_formula():
    torch.manual_seed(0)
    block = Residual(
        4, 5, ConvNorm(4, 2), nn.Sequential(ConvNorm(4, 2), ConvNorm(2, 3, (1, 3))), scale=0.3
    ).eval()
    inputs = torch.randn(2, 4, 5, 6)
    unchanged = inputs.clone()
    joined = torch.cat([block.branch0(inputs), block.branch1(inputs)], 1)
    expected = (inputs + 0.3 * block.conv2d(joined)).clamp(min=0)
    torch.testing.assert_close(block(inputs), expected)
    assert torch.equal(inputs, unchanged)
    unrectified = Residual(4, 2, ConvNorm(4, 2), scale=1.0, relu=False).eval()
    assert (unrectified(inputs) < 0).any()


def test_a_convolution_block_is_its_formula():
    torch.manual_seed(0)
    block = ConvNorm(3, 4, 3, stride=2, padding="valid").double()
    inputs = torch.randn(5, 3, 9, 9, dtype=torch.float64)
    raw = nn.functional.conv2d(inputs, block.conv.weight, stride=2)
    deviation = (raw.var((0, 2, 3), unbiased=False, keepdim=True) + 1e-3).sqrt()  # ε as published
    expected = ((raw - raw.mean((0, 2, 3), keepdim=True)) / deviation).clamp(min=0)
    torch.testing.assert_close(block(inputs), expected)


def test_the_mean_over_a_border_leaves_the_padding_out():
    block = mixed_5b().eval()
    with torch.no_grad():
        block.branch3[1].conv.weight.fill_(1 / 192)
        maps = block(torch.ones(1, 192, 4, 4))[:, -64:]
    torch.testing.assert_close(maps, torch.full((1, 64, 4, 4), 1 / (1 + 1e-3) ** 0.5))


def test_says_what_of_the_weights_does_not_fit(encoder, tmp_path):
    file = tmp_path / "weights.pth"
    torch.save({"features.0.weight": torch.zeros(2)}, file)
    with pytest.raises(CheckpointError, match=r"does not fit InceptionResNetV2: .* missing.*unknown"):
        InceptionResNetV2((3, 75, 75), weights=str(file))


@pytest.mark.parametrize("shape", [(512,), (4, 99, 99), (99, 99)])
def test_refuses_what_is_no_image(shape):
    with pytest.raises(ConfigError, match="reads images of shape"):
        InceptionResNetV2(shape)


def test_refuses_small_images():
    with pytest.raises(ConfigError, match="at least 75 × 75 pixels, but got images of 299 × 74"):
        InceptionResNetV2((3, 299, 74))
