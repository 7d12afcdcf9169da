"""Tests of the moments against stored weights, and of predictions against models with the drawn weights."""

import copy

import numpy as np
import pytest
import torch
from torch import nn

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from framework.model import Model
from framework.target import Target
from framework.testing.finding import require
from framework.testing.plain import Plain
from framework.testing.rows import WrapperRow
from framework.testing.wrappers import examine_wrapper
from plugins.uncertainty.swag.moments import Moments, add, draw
from plugins.uncertainty.swag.rows import ROWS
from plugins.uncertainty.swag.wrapper import Swag

REAL = Target("real", ("x",))


def moments(size, rank, dtype=torch.float64):
    zeros = torch.zeros(size, dtype=dtype)
    return Moments(torch.tensor(0), zeros, zeros.clone(), torch.zeros(rank, size, dtype=dtype))


@pytest.mark.parametrize("dtype, error", [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_the_moments_are_those_of_the_stored_weights(dtype, error):
    path = 1000 + np.cumsum(np.random.default_rng(0).normal(size=(13, 5)), 0)
    statistics = moments(5, 4, dtype)
    for weights in path:
        add(statistics, torch.tensor(weights, dtype=dtype))
    assert statistics.count == 13
    np.testing.assert_allclose(statistics.mean.numpy(), path.mean(0), rtol=error)
    np.testing.assert_allclose(statistics.squares.numpy() / 13, path.var(0), rtol=1e3 * error)
    columns = {number % 4: path[number] - path[: number + 1].mean(0) for number in range(9, 13)}
    stored = np.array([columns[row] for row in range(4)])
    np.testing.assert_allclose(statistics.deviations.numpy(), stored, atol=1e3 * error, rtol=0)


@pytest.mark.parametrize("epochs", [3, 9])
def test_the_covariance_of_draws_is_half_diagonal_and_half_of_low_rank(epochs):
    path = np.random.default_rng(1).normal(size=(epochs, 6))
    statistics = moments(6, 4)
    for weights in path:
        add(statistics, torch.tensor(weights))
    # unit vectors instead of noise give the columns of a root of the covariance
    columns = np.array(
        [(draw(statistics, unit) - statistics.mean).numpy() for unit in torch.eye(10, dtype=torch.float64)]
    )
    running = np.cumsum(path, 0) / np.arange(1, epochs + 1)[:, None]
    last = (path - running)[-4:]
    wanted = np.diag(path.var(0)) / 2 + last.T @ last / (2 * (len(last) - 1))
    np.testing.assert_allclose(columns.T @ columns, wanted, rtol=1e-10, atol=1e-12)
    assert torch.equal(draw(statistics, torch.zeros(10, dtype=torch.float64)), statistics.mean)


def model(encoder, head="gaussian"):
    torch.manual_seed(0)
    built = build("encoder", resolve("encoder", encoder), input_shape=(4,))
    return Model([built], build("density_head", resolve("density_head", head), target=REAL))


def follow(wrapper, epochs=6, size=0.1):
    """Let the wrapper read weights that change at random after each epoch."""
    generator = torch.Generator().manual_seed(2)
    for epoch in range(epochs):
        with torch.no_grad():
            for parameter in wrapper.model.parameters():
                parameter += size * torch.randn(parameter.shape, generator=generator).to(parameter)
        wrapper.after_epoch(epoch, epochs)
    return wrapper


@pytest.mark.parametrize("vectorises", [True, False])
def test_a_prediction_is_the_mean_over_models_with_the_drawn_weights(vectorises):
    wrapper = Swag(lambda: model({"name": "mlp", "widths": [8, 8]}), start=0.5, samples=5)
    wrapper.model.encoders[0].vectorises = vectorises
    follow(wrapper).eval()
    assert wrapper.count == 3
    inputs, target = torch.randn(7, 4), torch.randn(7, 1)
    with torch.no_grad():
        log_prob = wrapper(inputs).log_prob(target)
        parts = []
        for weights in wrapper._draws():
            alone = copy.deepcopy(wrapper.model)
            nn.utils.vector_to_parameters(weights, alone.parameters())
            parts.append(alone(inputs).log_prob(target).exp())
    assert torch.stack(parts).std(0).min() > 0
    torch.testing.assert_close(log_prob.exp(), torch.stack(parts).mean(0), rtol=1e-4, atol=1e-6)


def test_the_density_is_the_models_if_training_does_not_move_the_weights():
    wrapper = follow(Swag(lambda: model({"name": "mlp", "widths": [8]}), start=0.0), size=0.0).eval()
    inputs, target = torch.randn(7, 4), torch.randn(7, 1)
    with torch.no_grad():
        torch.testing.assert_close(wrapper(inputs).log_prob(target), wrapper.model(inputs).log_prob(target))


def test_a_repeated_epoch_is_read_once_and_the_state_continues():
    wrapper = follow(Swag(lambda: model({"name": "mlp", "widths": [8]}), start=0.0), 3)
    other = Swag(lambda: model({"name": "mlp", "widths": [8]}), start=0.0)
    other.load_state_dict(wrapper.state_dict())
    other.after_epoch(2, 3)
    assert other.count == 3
    other.after_epoch(3, 4)
    wrapper.after_epoch(3, 4)
    assert other.count == 4
    for name, value in wrapper.state_dict().items():
        assert torch.equal(value, other.state_dict()[name]), name


def test_the_model_is_calibrated_with_the_mean_weights_and_keeps_its_own():
    wrapper = follow(
        Swag(lambda: model({"name": "mlp", "widths": [8]}, {"name": "gaussian", "scale": "fixed"}))
    ).eval()
    before = copy.deepcopy(wrapper.model.state_dict())
    batch = {"input": torch.randn(30, 4), "target": torch.randn(30, 1)}
    wrapper.calibrate([batch])
    at_mean = copy.deepcopy(wrapper.model)
    nn.utils.vector_to_parameters(wrapper.mean, at_mean.parameters())
    at_mean.calibrate([batch])
    assert torch.equal(at_mean.head.scale, wrapper.model.head.scale)
    for name, parameter in wrapper.model.named_parameters():
        assert torch.equal(parameter, before[name])


@pytest.mark.parametrize("row", ROWS["swag"], ids=lambda row: row.name)
def test_the_contract_holds_for_collected_weights(row):
    config = resolve("uncertainty", {"name": "swag", **row.config})

    def make(target):
        return follow(build("uncertainty", config, model=lambda: Plain(target), target=target))

    # collected weights are another model than the one whose training densities are compared
    compared = WrapperRow(
        row.name, row.target, leave_out={"training densities": "they are those of the last weights"}
    )
    require(*examine_wrapper(compared, make, None))


def test_models_whose_draws_would_be_wrong_are_refused():
    with pytest.raises(ConfigError, match="batch norm"):
        Swag(lambda: model({"name": "mlp", "widths": [8], "batch_norm": True}))
    with pytest.raises(ConfigError, match="has weights of its own"):
        Swag(lambda: model({"name": "mlp", "widths": [8]}, {"name": "cvae", "component": "gaussian"}))
    cvae = {"name": "cvae", "component": "gaussian"}
    members = resolve("uncertainty", {"name": "ensemble", "members": 2})
    with pytest.raises(
        ConfigError, match="has weights of its own"
    ):  # the heads of a vectorised ensemble are apart
        Swag(lambda: build("uncertainty", members, model=lambda: model({"name": "mlp", "widths": [8]}, cvae)))
    wrapper = Swag(lambda: model({"name": "mlp", "widths": [8]}))
    wrapper.samples = 0
    with pytest.raises(ConfigError, match="samples is 0, expected 1 or more"):
        wrapper(torch.zeros(2, 4))


@pytest.mark.parametrize("config", [{"start": 1.0}, {"rank": -1}, {"samples": 0}])
def test_a_config_out_of_range_is_refused(config):
    with pytest.raises(ConfigError, match=r"uncertainty\."):
        resolve("uncertainty", {"name": "swag", **config})
