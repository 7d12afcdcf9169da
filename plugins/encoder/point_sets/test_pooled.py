"""Tests of maxima over each cloud, computed from few points, against the maxima over all points."""

import copy

import pytest
import torch
from torch import nn

from plugins.encoder.point_sets.deepsets import DeepSets
from plugins.encoder.point_sets.layers import layers
from plugins.encoder.point_sets.point_sets import largest
from plugins.encoder.point_sets.pointnet import PointNet
from plugins.encoder.point_sets.pooled import _shortcut_pays, largest_after, rows_of_maxima

NUMBERS = {"even": (70, 70, 70), "uneven": (90, 1, 150, 40), "one": (80,)}


def build_network(columns=5, channels=24, dtype=torch.float64):
    """Return a network whose batch norms have factors of both signs and running moments from a batch."""
    torch.manual_seed(0)
    network = layers(columns, [6, channels]).to(dtype)
    for layer in network:
        if isinstance(layer, nn.BatchNorm1d):
            nn.init.normal_(layer.weight)
            nn.init.normal_(layer.bias)
    network(torch.randn(50, columns, dtype=dtype))
    return network


def plain(network, values, counts):
    return largest(network(values), counts)


def outcome(function, network, values, counts):
    """Return the value, the gradients of the inputs and all parameters, and the buffers of batch norm afterwards."""
    network, values = copy.deepcopy(network), values.clone().requires_grad_()
    maxima = function(network, values, counts)
    (
        maxima * torch.arange(1.0, maxima.numel() + 1, dtype=maxima.dtype).view_as(maxima).cos()
    ).sum().backward()
    gradients = {name: parameter.grad for name, parameter in network.named_parameters()}
    return {"value": maxima.detach(), "inputs": values.grad, **gradients, **dict(network.named_buffers())}


@pytest.mark.parametrize("numbers", NUMBERS.values(), ids=NUMBERS)
@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize(
    "dtype, near",
    [(torch.float64, {"rtol": 1e-9, "atol": 1e-10}), (torch.float32, {"rtol": 2e-3, "atol": 2e-5})],
    ids=str,
)
def test_value_gradients_and_moments_are_those_of_every_point(numbers, training, dtype, near):
    network = build_network(dtype=dtype).train(training)
    values, counts = torch.randn(sum(numbers), 5, dtype=dtype) + 3, torch.tensor(numbers)
    hidden = network[:3](values)
    assert _shortcut_pays(network[3], network[4], hidden, counts) == (sum(numbers) >= 64 * len(numbers))
    wanted = outcome(plain, network, values, counts)
    for name, results in outcome(largest_after, network, values, counts).items():
        torch.testing.assert_close(
            results, wanted[name], **near, msg=lambda text, name=name: f"{name}: {text}"
        )


def test_momentum_of_a_cumulative_average_and_norms_without_running_moments():
    values, counts = torch.randn(200, 5, dtype=torch.float64), torch.tensor([100, 100])
    for tracked in (True, False):
        network = build_network()
        network[4] = nn.BatchNorm1d(24, momentum=None, track_running_stats=tracked, dtype=torch.float64)
        for training in (True, False):
            network.train(training)
            wanted, results = (
                outcome(plain, network, values, counts),
                outcome(largest_after, network, values, counts),
            )
            assert wanted.keys() == results.keys()
            for name in wanted:
                torch.testing.assert_close(results[name], wanted[name], rtol=1e-9, atol=1e-10)


def test_a_variance_that_the_covariance_does_not_show_is_taken_from_every_point():
    """Check a channel that reads the small difference of two large numbers, in float32."""
    torch.manual_seed(0)
    network = layers(2, [8])
    with torch.no_grad():
        network[0].weight[:] = torch.tensor([1.0, -1.0])
    large = torch.randn(200, 1) * 1e3
    values, counts = torch.cat([large, large + torch.randn(200, 1) * 0.01], 1), torch.tensor([100, 100])
    assert _shortcut_pays(network[0], network[1], values, counts)
    wanted, results = outcome(plain, network, values, counts), outcome(largest_after, network, values, counts)
    assert (wanted["value"] > 0).all()
    for name in wanted:
        assert torch.equal(results[name], wanted[name])


def test_what_is_not_a_number_is_not_made_one():
    network, counts = build_network(dtype=torch.float32), torch.tensor([100, 100])
    values = torch.randn(200, 5)
    values[3, 2] = torch.nan
    assert largest_after(network, values, counts).isnan().all()
    assert largest_after(network.eval(), values, counts)[0].isnan().all()


def test_a_norm_of_other_kind_and_mixed_precision_see_every_point(monkeypatch):
    values, counts = torch.randn(200, 5), torch.tensor([100, 100])
    calls = []
    monkeypatch.setattr(
        "plugins.encoder.point_sets.pooled.rows_of_maxima", lambda *arguments: calls.append(arguments)
    )
    network = build_network(dtype=torch.float32)
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(
            largest_after(network, values, counts), largest(network(values), counts), rtol=0.05, atol=0.05
        )
    with torch.no_grad():
        torch.testing.assert_close(largest_after(network, values, counts), largest(network(values), counts))
    network[4] = type("Other", (nn.BatchNorm1d,), {})(24)
    assert torch.equal(largest_after(network, values, counts), largest(network(values), counts))
    assert not calls


def test_rows_that_attain_the_largest_product():
    torch.manual_seed(0)
    values, weight = torch.randn(30, 4), torch.randn(7, 4)
    rows = rows_of_maxima(values, weight, torch.tensor([10, 1, 19]))
    for cloud, (first, last) in enumerate(((0, 10), (10, 11), (11, 30))):
        assert torch.equal(rows[cloud] - first, (values[first:last] @ weight.T).argmax(0))


@pytest.mark.parametrize("config", [{"variant": "full"}, {"variant": "vanilla"}], ids=str)
def test_pointnet_learns_what_it_would_from_every_point(config, monkeypatch):
    """Compare gradients of a whole network in training with and without the shortcut, for clouds of any size."""
    torch.manual_seed(0)
    network = PointNet((300, 3), point_widths=[8, 8, 8, 32], widths=[12, 8], dropout=0.0, **config).double()
    clouds = torch.randn(6, 300, 3, dtype=torch.float64)
    clouds[2, 40:] = torch.nan
    results = {}
    for points in (64, 10**9):
        monkeypatch.setattr("plugins.encoder.point_sets.pooled.POINTS", points)
        copied, inputs = copy.deepcopy(network), clouds.clone().requires_grad_()
        copied(inputs).square().sum().backward()
        results[points] = [inputs.grad, *(parameter.grad for parameter in copied.parameters())]
    for mine, every in zip(*results.values(), strict=True):
        torch.testing.assert_close(mine, every, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("activation", ["tanh", "elu"])
def test_deepsets_learns_from_few_points_what_it_would_from_all(activation):
    torch.manual_seed(0)
    network = DeepSets(
        (400, 3), channels=[16, 12, 8], widths=[8], activation=activation, dropout=0.0
    ).double()
    clouds = torch.randn(5, 400, 3, dtype=torch.float64)
    clouds[1, 30:] = torch.nan
    clouds[2, 1] = clouds[2, 0]
    passed = []
    hook = network.equivariant[0].register_forward_hook(
        lambda _, arguments, __: passed.append(len(arguments[0]))
    )
    results = {}
    for every in (False, True):
        copied = copy.deepcopy(network)
        if every:
            copied._attaining = lambda values, counts: (torch.arange(len(values)), counts)
        inputs = clouds.clone().requires_grad_()
        value = copied(inputs)
        value.square().sum().backward()
        results[every] = [value.detach(), inputs.grad, *(parameter.grad for parameter in copied.parameters())]
    hook.remove()
    assert passed[0] < 250 < passed[1] == 4 * 400 + 30
    for mine, all_of_them in zip(*results.values(), strict=True):
        torch.testing.assert_close(mine, all_of_them, rtol=1e-9, atol=1e-12)
    with torch.no_grad():
        torch.testing.assert_close(network(clouds), results[True][0], rtol=1e-12, atol=1e-12)
