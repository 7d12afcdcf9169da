import numpy as np
import pytest
import torch
from scipy.signal import correlate

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from plugins.encoder.grids.voxnet import VoxNet


def build_encoder(shape, **config):
    torch.manual_seed(0)
    return build("encoder", resolve("encoder", {"name": "voxnet", **config}), input_shape=shape)


def correlate_filters(grid, kernel, bias, stride, padding):
    """Return the correlation by SciPy, one filter at a time; every second cell for stride 2."""
    grid = np.pad(grid, [(0, 0)] + [(padding, padding)] * 3)
    filtered = np.stack([correlate(grid, filters, "valid", method="direct")[0] for filters in kernel])
    return filtered[:, ::stride, ::stride, ::stride] + bias[:, None, None, None]


def max_pool(grid):
    side = grid.shape[1] // 2
    grid = grid[:, : 2 * side, : 2 * side, : 2 * side]
    return grid.reshape(len(grid), side, 2, side, 2, side, 2).max((2, 4, 6))


def by_hand(encoder, grid):
    """Return the output of the layers in NumPy and SciPy for one grid, float64."""
    grid = grid.astype(np.float64)
    for layer in encoder.convolutions:
        state = {name: value.double().numpy() for name, value in layer.state_dict().items()}
        if isinstance(layer, torch.nn.Conv3d):
            grid = correlate_filters(grid, state["weight"], state["bias"], layer.stride[0], layer.padding[0])
        elif isinstance(layer, torch.nn.BatchNorm3d):
            scale = state["weight"] / np.sqrt(state["running_var"] + 1e-5)
            shift = state["bias"] - state["running_mean"] * scale
            grid = grid * scale[:, None, None, None] + shift[:, None, None, None]
        elif isinstance(layer, torch.nn.MaxPool3d):
            grid = max_pool(grid)
        elif isinstance(layer, torch.nn.LeakyReLU):
            grid = np.where(grid > 0, grid, 0.1 * grid)
        elif isinstance(layer, torch.nn.ReLU):
            grid = np.maximum(grid, 0)
    numbers = grid.reshape(-1)
    for layer in encoder.connected:
        if isinstance(layer, torch.nn.Linear):
            weight, bias = layer.weight.detach().numpy(), layer.bias.detach().numpy()
            numbers = np.maximum(weight @ numbers + bias, 0)
    return numbers


@pytest.mark.parametrize(
    "shape, config",
    [
        ((1, 11, 11, 11), {"channels": [3, 2], "widths": [5]}),
        ((3, 10, 10, 10), {"channels": [2], "widths": [5, 4]}),
        ((1, 12, 12, 12), {"variant": "conv3d", "channels": [2, 3], "widths": [6, 4]}),
        ((3, 9, 9, 9), {"variant": "conv3d", "channels": [2, 3, 4, 2], "widths": [6, 4], "padding": 1}),
    ],
)
def test_agrees_with_scipy(shape, config):
    encoder = build_encoder(shape, **config).double()
    encoder(
        torch.randn(6, *shape, dtype=torch.float64) + 0.5
    )  # moves the running moments away from their initial values
    with torch.no_grad():
        for parameter in encoder.parameters():
            parameter.add_(0.05)
    grids = torch.randn(2, *shape, dtype=torch.float64)
    features = encoder.eval()(grids).detach().numpy()
    wanted = np.stack([by_hand(encoder, grid) for grid in grids.numpy()])
    assert np.abs(wanted).max() > 0.01
    np.testing.assert_allclose(features, wanted, rtol=1e-12, atol=1e-12)
    single = encoder.float()(grids.float()).detach().numpy()
    np.testing.assert_allclose(single, wanted, rtol=1e-4, atol=1e-5)


def parameters(encoder, classes=40):
    """Return the number of parameters with the last linear layer, as tables count them."""
    count = sum(parameter.numel() for parameter in encoder.parameters())
    return count + (encoder.output_shape[0] + 1) * classes


def test_voxnet_has_the_published_parameters():
    assert parameters(VoxNet((1, 32, 32, 32))) == 921_736  # Maturana & Scherer 2015, Table I


def test_conv3d_has_the_parameters_of_the_thesis():
    norms = 2 * (8 + 16 + 32 + 64)
    convolutions = 27 * (8 + 8 * 16 + 16 * 32 + 32 * 64) + 8 + 16 + 32 + 64
    # 32 → 30 → 28 → 14 → 12 → 10 → 5 cells a side
    connected = (64 * 5**3 + 1) * 512 + 513 * 512 + 513 * 40
    count = parameters(VoxNet((1, 32, 32, 32), variant="conv3d"))
    assert count == norms + convolutions + connected
    assert count == pytest.approx(4.4e6, rel=0.02)  # Table 6.2
    assert count * 4 == pytest.approx(18e6, rel=0.02)  # bytes, Table 6.3


@pytest.mark.parametrize(
    "config, side",
    [
        ({}, 11),
        ({"channels": [2]}, 7),
        ({"channels": [2, 2, 2]}, 15),
        ({"variant": "conv3d"}, 16),
        ({"variant": "conv3d", "padding": 1}, 4),
        ({"variant": "conv3d", "channels": [2]}, 3),
    ],
)
def test_the_smallest_grid_works_and_a_smaller_one_is_refused(config, side):
    encoder = build_encoder((1, side, side, side), **config).eval()
    assert encoder(torch.rand(2, 1, side, side, side)).shape == (2, *encoder.output_shape)
    with pytest.raises(
        ConfigError, match=f"needs a grid of at least {side} cells a side, but got {side - 1}"
    ):
        build_encoder((1, side - 1, side - 1, side - 1), **config)


@pytest.mark.parametrize("shape", [(512,), (3, 48, 48), (1, 32, 32, 30), (2048, 3), (1, 8, 8, 8, 1)])
def test_refuses_what_is_no_cube(shape):
    with pytest.raises(ConfigError, match=r"reads grids of shape \(channels, side, side, side\)"):
        VoxNet(shape)


@pytest.mark.parametrize(
    "config", [{"dropout": [0.5]}, {"variant": "conv3d", "widths": [4]}, {"variant": "conv3d", "dropout": []}]
)
def test_refuses_another_number_of_dropout_layers(config):
    with pytest.raises(ConfigError, match="dropout has"):
        build_encoder((1, 32, 32, 32), **config)


@pytest.mark.parametrize(
    "config",
    [{"channels": []}, {"channels": [0]}, {"dropout": [1.0, 0, 0]}, {"variant": "vox"}, {"padding": 2}],
)
def test_refuses_a_config_out_of_range(config):
    with pytest.raises(ConfigError, match=r"encoder\."):
        resolve("encoder", {"name": "voxnet", **config})


def test_dropout_is_where_it_is_published():
    for variant, wanted in (("voxnet", [0.2, 0.3, 0.4]), ("conv3d", [0.8, 0.6])):
        encoder = VoxNet((1, 32, 32, 32), variant=variant)
        assert [part.p for part in encoder.modules() if isinstance(part, torch.nn.Dropout)] == wanted
