"""Tests of heads that predict flights: coverage of simulated flights, identified constants, and refusals."""

import re
from dataclasses import fields
from typing import Literal

import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError, NonFiniteParameters
from framework.flights.frames import future_names
from framework.flights.physics import Constants
from framework.model import Model
from framework.target import Target
from framework.testing.flights import SIGMA, STEP, TWO_FRAMES, falling_balls, simulate_windows
from plugins.density_head.flights.ballistic import BallisticHead
from plugins.density_head.flights.identification import FITTED, HIGH, LOW


@pytest.mark.parametrize("density", ["linearised", "sampled"])
def test_the_physics_covers_what_it_simulated(density: str) -> None:
    frames, future, _ = simulate_windows(60)
    target = Target("real", future_names(35, STEP))
    config = {"name": "ballistic", "density": density, "identify": False, "samples": 60}
    head = build("density_head", resolve("density_head", config), target=target).eval()
    torch.manual_seed(0)
    samples = head(frames.flatten(1)).sample((199,))
    noisy = future.flatten(1) + SIGMA * torch.randn(future.flatten(1).shape)
    rank = (samples < noisy).sum(0)
    assert ((rank >= 10) & (rank < 190)).double().mean().item() == pytest.approx(0.9, abs=0.05)


def test_heads_refuse_what_is_no_flight() -> None:
    target = Target("real", ("x", "y"))
    for name in ("ballistic", "lstm"):
        with pytest.raises(ConfigError, match="predicts x, y and z at successive times"):
            build("density_head", resolve("density_head", name), target=target)


@pytest.mark.parametrize("nonsense", [pytest.param(False, marks=pytest.mark.slow), True])
def test_constants_are_found_and_of_nonsense_stay_within_their_bounds(nonsense: bool) -> None:
    frames, future, _ = simulate_windows(12)
    target = Target("real", future_names(35, STEP))
    wrong = {"drag": 0.1, "lift": 0.001, "restitution": 0.8, "friction": 0.2, "surface": -0.93}
    head = build("density_head", resolve("density_head", {"name": "ballistic", **wrong}), target=target)
    torch.manual_seed(0)
    if nonsense:
        frames, future = torch.randn_like(frames)[:2], torch.randn_like(future)[:2]
    head.fit(frames.flatten(1), future.flatten(1) + SIGMA * torch.randn(future.flatten(1).shape), 0)
    constants = head.constants
    for name, low, high in zip(FITTED, LOW, HIGH, strict=True):
        middle = wrong["surface"] if name == "surface" else 0.0
        assert middle + low <= getattr(constants, name) <= middle + high
        if not nonsense:
            near = {"lift": 1e-3, "restitution": 0.02, "surface": 0.003}.get(name, 0.01)
            assert getattr(constants, name) == pytest.approx(getattr(Constants(), name), abs=near), name
    if not nonsense:
        assert head.noise.item() == pytest.approx(SIGMA, rel=0.1)


def fit(
    moved: torch.Tensor | None = None, order: tuple[int, ...] = (0, 1, 2), **config: object
) -> BallisticHead:
    """Return a head that was fitted to 24 simulated windows, whose axes are exchanged and whose origin is moved."""
    frames, future, _ = simulate_windows(24)
    torch.manual_seed(1)
    future = future + SIGMA * torch.randn(future.shape)
    offset = torch.zeros(3) if moved is None else moved
    frames, future = frames.clone(), future[..., list(order)] + offset
    frames[..., 1:4] = (frames[..., 1:4][..., list(order)] + offset) * frames[..., 4:]
    target = Target("real", future_names(35, STEP))
    head = build("density_head", resolve("density_head", {"name": "ballistic", **config}), target=target)
    head.fit(frames.flatten(1), future.flatten(1), 0)
    return head


@pytest.mark.slow
def test_constants_are_found_with_their_errors_at_any_height_of_the_table() -> None:
    """The simulated constants lie within four standard errors, which are not too wide either."""
    usual, moved = fit(), fit(torch.tensor([0.3, 0.0, 1.71]))
    assert moved.constants.surface == pytest.approx(usual.constants.surface + 1.71, abs=1e-3)
    assert moved.remark.startswith("ballistic: drag 0.1")
    for number, name in enumerate(FITTED):
        value, error = map(float, re.findall(rf"{name} (\S+) ± ([\d.]+)", usual.remark)[0])
        assert value == pytest.approx(usual.found[number].item(), abs=error)
        assert abs(value - getattr(Constants(), name)) < 4 * error, name
        assert error < {"drag": 0.02, "lift": 1e-3, "surface": 3e-3}.get(name, 0.05), name


@pytest.mark.parametrize(
    "order, moved, config, message",
    [
        ((0, 2, 1), (0.0, 0.0, 0.0), {}, r"fall along -y.*z points up"),
        ((0, 1, 2), (0.0, 5.0, 0.0), {}, r"bounces at y from .* Set near and far"),
        ((0, 1, 2), (0.0, 0.0, 0.5), {"identify": False}, r"bounces at a height of -0\.4.*identify=true"),
    ],
)
def test_another_frame_of_reference_is_refused(
    order: tuple[int, ...], moved: tuple[float, ...], config: dict[str, object], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        fit(torch.tensor(moved), order, **config)


@pytest.mark.parametrize("density", ["linearised", "sampled"])
@pytest.mark.parametrize("value", [1e-30, 1e3, 1e30])
@pytest.mark.parametrize("name", ["step", *(field.name for field in fields(Constants))])
def test_physics_far_from_any_ball_give_a_density_or_a_sentence(
    name: str, value: float, density: Literal["linearised", "sampled"]
) -> None:
    step, constants = (value, Constants()) if name == "step" else (0.016, Constants(**{name: value}))
    head = BallisticHead(
        TWO_FRAMES,
        observed=6,
        step=step,
        density=density,
        samples=3,
        steps=5,
        identify=False,
        constants=constants,
    )
    try:
        log_prob = head(falling_balls(2)).log_prob(torch.zeros(2, 6))
    except NonFiniteParameters as error:
        assert "in batch row 0" in str(error)
    else:
        assert log_prob.isfinite().all()


def test_a_window_of_another_length_than_the_head_reads_is_refused() -> None:
    head = BallisticHead(TWO_FRAMES, observed=7, constants=Constants())
    with pytest.raises(ConfigError, match="BallisticHead reads 35 numbers per sample, but its input has 30"):
        Model([], head, (30,))
