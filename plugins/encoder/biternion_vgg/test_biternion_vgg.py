import numpy as np
import pytest
import torch
from scipy.signal import correlate

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from plugins.encoder.biternion_vgg.encoder import BiternionVGG


def by_hand(encoder, images):
    """Return the output of Beyer's layers in NumPy and SciPy, with ReLU before the pooling, image by image."""
    state = {name: value.double().numpy() for name, value in encoder.state_dict().items()}
    convolutions = sorted({int(name.split(".")[1]) for name in state if name.endswith("running_var")})
    rows = []
    for image in images.astype(np.float64):
        for number, norm in enumerate(convolutions, start=1):
            kernel = state[f"convolutions.{norm - 1}.weight"]
            image = np.stack([correlate(image, filters, "valid")[0] for filters in kernel])
            weight, bias, mean, variance = (
                state[f"convolutions.{norm}.{name}"][:, None, None]
                for name in ("weight", "bias", "running_mean", "running_var")
            )
            image = np.maximum((image - mean) / np.sqrt(variance + 1e-5) * weight + bias, 0)
            if number % 2 == 0 and number < len(convolutions):
                planes, height, width = image.shape
                image = image[:, : height // 2 * 2, : width // 2 * 2]
                image = image.reshape(planes, height // 2, 2, width // 2, 2).max((2, 4))
        connected = state["fully_connected.weight"] @ image.ravel() + state["fully_connected.bias"]
        rows.append(np.maximum(connected, 0))
    return np.stack(rows)


@pytest.mark.parametrize(
    "shape, channels",
    [
        ((3, 48, 48), [24, 24, 48, 48, 64, 64]),
        ((1, 33, 41), [3, 2, 4, 3, 2, 5]),
        ((3, 11, 13), [2, 3, 4]),
        ((3, 3, 3), [2]),
    ],
)
def test_agrees_with_numpy(shape, channels):
    torch.manual_seed(0)
    config = resolve("encoder", {"name": "biternion_vgg", "channels": channels, "features": 20})
    encoder = build("encoder", config, input_shape=shape)
    encoder(torch.rand(8, *shape) * 2 - 1)  # moves the running moments away from their initial values
    images = torch.rand(2, *shape)
    features = encoder.eval()(images)
    assert features.shape == (2, 20)
    assert features.dtype == torch.float32
    np.testing.assert_allclose(
        features.detach().numpy(), by_hand(encoder, images.numpy()), rtol=1e-4, atol=1e-5
    )


def test_is_the_published_network():
    encoder = BiternionVGG((3, 46, 46))  # the size of the images in Beyer et al. 2015
    shapes = [tuple(weight.shape) for name, weight in encoder.named_parameters() if weight.dim() == 4]
    widths = [(24, 3), (24, 24), (48, 24), (48, 48), (64, 48), (64, 64)]
    assert shapes == [(*width, 3, 3) for width in widths]
    convolutions = 9 * (3 * 24 + 24 * 24 + 24 * 48 + 48 * 48 + 48 * 64 + 64 * 64)
    norms = 2 * (24 + 24 + 48 + 48 + 64 + 64)
    # 46 → 44 → 42 → 21 → 19 → 17 → 8 → 6 → 4 pixels a side
    connected = 64 * 4 * 4 * 512 + 512
    assert sum(parameter.numel() for parameter in encoder.parameters()) == convolutions + norms + connected
    assert encoder.output_shape == (512,)


@pytest.mark.parametrize("convolutions, side", [(1, 3), (2, 5), (3, 10), (4, 14), (6, 32), (8, 68)])
def test_the_smallest_image_works_and_a_smaller_one_is_refused(convolutions, side):
    channels = [2] * convolutions
    encoder = BiternionVGG((1, side, side), channels=channels, features=4).eval()
    assert encoder(torch.rand(1, 1, side, side)).shape == (1, 4)
    with pytest.raises(
        ConfigError, match=f"at least {side} × {side} pixels, but got images of {side - 1} × {side}"
    ):
        BiternionVGG((1, side - 1, side), channels=channels)


@pytest.mark.parametrize("shape", [(512,), (4, 48, 48), (48, 48), (3, 48, 48, 1)])
def test_refuses_what_is_no_image(shape):
    with pytest.raises(ConfigError, match="reads images of shape"):
        BiternionVGG(shape)


@pytest.mark.parametrize(
    "config", [{"channels": []}, {"channels": [0]}, {"features": 0}, {"dropout": 1}, {"droput": 0}]
)
def test_refuses_a_config_out_of_range(config):
    with pytest.raises(ConfigError, match=r"encoder\."):
        resolve("encoder", {"name": "biternion_vgg", **config})
