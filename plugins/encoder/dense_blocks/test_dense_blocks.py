import numpy as np
import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from plugins.encoder.dense_blocks.encoder import DenseBlocks


def by_hand(encoder, inputs):
    """Return the features in NumPy, float64: linear layers, batch norm by running moments, ReLU, concatenation."""
    numbers = inputs.reshape(len(inputs), -1).astype(np.float64)
    for block in encoder.blocks:
        inner = numbers
        for layer in block:
            state = {name: value.double().numpy() for name, value in layer.state_dict().items()}
            if isinstance(layer, torch.nn.Linear):
                inner = inner @ state["weight"].T + state.get("bias", 0)
            elif isinstance(layer, torch.nn.BatchNorm1d):
                inner = (inner - state["running_mean"]) / np.sqrt(state["running_var"] + layer.eps)
                inner = inner * state["weight"] + state["bias"]
            elif isinstance(layer, torch.nn.ReLU):
                inner = np.maximum(inner, 0)
        numbers = np.concatenate([numbers, inner], 1)
    state = {name: value.double().numpy() for name, value in encoder.bottleneck.state_dict().items()}
    return numbers @ state["weight"].T + state["bias"] if state else numbers


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-5), (torch.float64, 1e-13)])
@pytest.mark.parametrize("bottleneck", [None, 3])
@pytest.mark.parametrize("batch_norm", [False, True])
@pytest.mark.parametrize("shape, blocks, layers", [((7,), 2, 2), ((3, 4), 1, 3), ((1,), 3, 1)])
def test_agrees_with_numpy(shape, blocks, layers, batch_norm, bottleneck, dtype, tolerance):
    torch.manual_seed(0)
    config = {"blocks": blocks, "layers": layers, "width": 12, "bottleneck": bottleneck}
    part = resolve("encoder", {"name": "dense_blocks", "batch_norm": batch_norm, "dropout": 0.3, **config})
    encoder = build("encoder", part, input_shape=shape).to(dtype)
    encoder(
        torch.randn(50, *shape, dtype=dtype) * 3 + 1
    )  # moves the running moments away from their initial values
    inputs = torch.randn(6, *shape, dtype=dtype)
    features = encoder.eval()(inputs)
    assert features.shape == (6, *encoder.output_shape)
    assert features.dtype == dtype
    wanted = by_hand(encoder, inputs.double().numpy())
    np.testing.assert_allclose(features.detach().numpy(), wanted, rtol=tolerance, atol=tolerance)


def test_features_are_standardised_by_the_moments_of_all_of_training():
    torch.manual_seed(0)
    encoder = DenseBlocks((3,), width=4, standardise=True).double()
    batches = [torch.randn(20, 3, dtype=torch.float64) * 0.01 + 5 for _ in range(7)]
    for batch in batches:
        encoder(batch)
    inputs = torch.randn(6, 3, dtype=torch.float64)
    features = encoder.eval()(inputs)[:, :3].detach().numpy()
    mean = np.mean([batch.numpy().mean(0) for batch in batches], 0)
    variance = np.mean([batch.numpy().var(0, ddof=1) for batch in batches], 0)
    np.testing.assert_allclose(features, (inputs.numpy() - mean) / np.sqrt(variance + 1e-5), rtol=1e-10)


def test_its_lengths_are_those_of_the_thesis():
    encoder = DenseBlocks((1024,))
    assert encoder.output_shape == (3072,)
    shapes = [tuple(layer.weight.shape) for layer in encoder.modules() if isinstance(layer, torch.nn.Linear)]
    assert shapes == [(1024, 1024), (1024, 1024), (1024, 2048), (1024, 1024)]


def test_the_features_themselves_come_first():
    encoder = DenseBlocks((4, 2), width=3)
    inputs = torch.randn(5, 4, 2)
    assert torch.equal(encoder(inputs)[:, :8], inputs.flatten(1))


def test_the_layer_after_the_narrow_one_has_its_rank():
    torch.manual_seed(0)
    encoder = DenseBlocks((6,), width=16, bottleneck=2).double()
    wide = torch.nn.Linear(2, 30).double()
    outputs = wide(encoder(torch.randn(40, 6, dtype=torch.float64))).detach()
    assert torch.linalg.matrix_rank(outputs - wide.bias.detach()) == 2


def test_dropout_acts_in_training_alone():
    torch.manual_seed(0)
    encoder = DenseBlocks((4,), blocks=1, layers=1, width=2000, dropout=0.25)
    inputs = torch.ones(1, 4)
    undropped, dropped = encoder.eval()(inputs)[:, 4:], encoder.train()(inputs)[:, 4:]
    alive = undropped > 0
    assert (dropped[alive] == 0).double().mean().item() == pytest.approx(0.25, abs=0.07)


def test_refuses_samples_without_numbers():
    with pytest.raises(ConfigError, match="hold no numbers"):
        DenseBlocks((3, 0))


@pytest.mark.parametrize(
    "config", [{"width": 0}, {"blocks": 0}, {"dropout": 1.0}, {"bottleneck": 0}, {"widths": 3}]
)
def test_refuses_a_config_out_of_range(config):
    with pytest.raises(ConfigError, match=r"encoder\."):
        resolve("encoder", {"name": "dense_blocks", **config})
