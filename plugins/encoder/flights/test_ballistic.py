"""Tests of the comparison of the encoder's table with the bounces of the training flights."""

import re

import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from framework.testing.flights import SIGMA, simulate_windows
from plugins.encoder.flights.ballistic import BallisticEncoder

FRAMES = 20


def encoder(**config: object) -> BallisticEncoder:
    return build("encoder", resolve("encoder", {"name": "ballistic", **config}), input_shape=(5 * FRAMES,))


def windows(
    moved: tuple[float, float, float] = (0.0, 0.0, 0.0), order: tuple[int, int, int] = (0, 1, 2)
) -> list[dict[str, torch.Tensor]]:
    """Return two batches of flights that bounce in their future frames, with exchanged axes and a moved origin."""
    frames, future, _ = simulate_windows(24)
    torch.manual_seed(1)
    offset = torch.tensor(moved)
    future = (future + SIGMA * torch.randn(future.shape))[..., list(order)] + offset
    frames[..., 1:4] = (frames[..., 1:4][..., list(order)] + offset) * frames[..., 4:]
    inputs, targets = frames.flatten(1), future.flatten(1)
    return [{"input": inputs[part], "target": targets[part]} for part in (slice(14), slice(14, None))]


def test_flights_on_the_table_of_the_config_are_accepted() -> None:
    encoder().check_training(windows())


def test_flights_without_a_bounce_say_nothing_about_the_table() -> None:
    batches = [{"input": batch["input"], "target": torch.zeros(len(batch["input"]))} for batch in windows()]
    encoder(surface=3.0).check_training(batches)


@pytest.mark.parametrize(
    "order, moved, message",
    [
        ((0, 2, 1), (0.0, 0.0, 0.0), r"fall along -y.* encoder ballistic expects that z points up"),
        ((0, 1, 2), (0.0, 5.0, 0.0), r"bounces at y from .* Set near and far of encoder ballistic"),
    ],
)
def test_another_frame_of_reference_is_refused(
    order: tuple[int, int, int], moved: tuple[float, float, float], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        encoder().check_training(windows(moved, order))


@pytest.mark.parametrize("moved", [0.96, -0.4])
def test_the_height_that_the_message_names_is_accepted(moved: float) -> None:
    batches = windows((0.0, 0.0, moved))
    with pytest.raises(ConfigError, match=r"Set encoder\.ballistic\.surface=") as raised:
        encoder().check_training(batches)
    (height,) = re.findall(r"surface=(-?[\d.]+)\.$", str(raised.value))
    assert float(height) == pytest.approx(moved - 0.95, abs=0.01)
    encoder(surface=float(height)).check_training(batches)
