import numpy as np
import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from plugins.encoder.mlp.encoder import MLP


def by_hand(encoder, inputs):
    """Return the features in NumPy: linear layers, batch norm with the running moments, activations."""
    state = {name: value.double().numpy() for name, value in encoder.state_dict().items()}
    numbers = inputs.reshape(len(inputs), -1).astype(np.float64)
    for index, layer in enumerate(encoder.layers):
        if isinstance(layer, torch.nn.Linear):
            numbers = numbers @ state[f"layers.{index}.weight"].T + state.get(f"layers.{index}.bias", 0)
        elif isinstance(layer, torch.nn.BatchNorm1d):
            mean, variance = state[f"layers.{index}.running_mean"], state[f"layers.{index}.running_var"]
            numbers = (numbers - mean) / np.sqrt(variance + layer.eps)
            numbers = numbers * state[f"layers.{index}.weight"] + state[f"layers.{index}.bias"]
        elif isinstance(layer, torch.nn.ReLU):
            numbers = np.maximum(numbers, 0)
        elif isinstance(layer, torch.nn.ELU):
            numbers = np.where(numbers > 0, numbers, np.expm1(np.minimum(numbers, 0)))
        elif isinstance(layer, torch.nn.SiLU):
            numbers = numbers / (1 + np.exp(-numbers))
    return numbers


@pytest.mark.parametrize("activation, units", [("relu", "ReLU"), ("elu", "ELU"), ("silu", "SiLU")])
@pytest.mark.parametrize("batch_norm", [False, True, "after_relu"])
@pytest.mark.parametrize("shape, widths", [((7,), [5]), ((3, 4, 2), [16, 8, 4]), ((1,), [1]), ((2, 3), [])])
def test_agrees_with_numpy(shape, widths, batch_norm, activation, units):
    torch.manual_seed(0)
    chosen = {"widths": widths, "batch_norm": batch_norm, "dropout": 0.3, "activation": activation}
    config = resolve("encoder", {"name": "mlp", **chosen})
    encoder = build("encoder", config, input_shape=shape)
    kinds = [type(layer).__name__ for layer in encoder.layers]
    order = {False: [units], True: ["BatchNorm1d", units], "after_relu": [units, "BatchNorm1d"]}[batch_norm]
    assert kinds == ["Linear", *order, "Dropout"] * len(widths)
    encoder(torch.randn(50, *shape) * 3 + 1)  # moves the running moments away from their initial values
    inputs = torch.randn(6, *shape)
    features = encoder.eval()(inputs)
    assert features.shape == (6, *encoder.output_shape)
    assert features.dtype == torch.float32
    np.testing.assert_allclose(
        features.detach().numpy(), by_hand(encoder, inputs.numpy()), rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize("batch_norm", [False, True, "after_relu"])
def test_an_empty_batch_in_training_gives_no_features(batch_norm):
    encoder = MLP((4,), widths=[3, 2], batch_norm=batch_norm).train()
    assert encoder(torch.randn(0, 4)).shape == (0, 2)


@pytest.mark.parametrize("dropout", [0.25, [0.25]])
def test_dropout_acts_in_training_alone(dropout):
    torch.manual_seed(0)
    encoder = MLP((4,), widths=[1000], dropout=dropout)
    inputs = torch.ones(1, 4)
    undropped = encoder.eval()(inputs)
    dropped = encoder.train()(inputs)
    alive = undropped > 0
    share = (dropped[alive] == 0).double().mean().item()
    assert share == pytest.approx(0.25, abs=0.1)  # about 500 units: five standard errors
    still = alive & (dropped > 0)
    torch.testing.assert_close(dropped[still], undropped[still] / 0.75)


def test_each_layer_has_its_dropout():
    """Check the probabilities of thesis §6.5.3: 0.8 and 0.4."""
    encoder = MLP((4,), widths=[3, 2], dropout=[0.8, 0.4])
    assert [layer.p for layer in encoder.layers if isinstance(layer, torch.nn.Dropout)] == [0.8, 0.4]
    with pytest.raises(ConfigError, match="3 probabilities for 2 layers"):
        MLP((4,), widths=[3, 2], dropout=[0.1, 0.2, 0.3])


def test_refuses_samples_without_numbers():
    with pytest.raises(ConfigError, match="hold no numbers"):
        MLP((3, 0, 4))


@pytest.mark.parametrize(
    "config",
    [
        {"widths": [0]},
        {"dropout": 1.0},
        {"dropout": float("nan")},
        {"dropout": [0.5, 1.0]},
        {"batch_norm": "after"},
        {"width": [3]},
    ],
)
def test_refuses_a_config_out_of_range(config):
    with pytest.raises(ConfigError, match=r"encoder\."):
        resolve("encoder", {"name": "mlp", **config})


def test_initial_weights_of_he_have_twice_the_variance_of_the_inputs():
    torch.manual_seed(0)
    encoder = MLP((200,), widths=[300, 300], initial="he")
    assert encoder.starts_flat and not MLP((3,)).starts_flat
    for layer, inputs in ((encoder.layers[0], 200), (encoder.layers[3], 300)):
        assert layer.weight.var().item() == pytest.approx(2 / inputs, rel=0.03)
        assert not layer.bias.any()
