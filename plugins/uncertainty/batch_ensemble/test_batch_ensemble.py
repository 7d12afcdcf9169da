"""Tests of members against models whose weights are multiplied by their matrices of rank one."""

import copy

import pytest
import torch
from torch import nn

from framework.configuration.schema import build, resolve
from framework.encoder import Encoder
from framework.errors import ConfigError
from framework.model import Model
from framework.target import Target
from plugins.uncertainty.batch_ensemble.layers import RankOne
from plugins.uncertainty.batch_ensemble.wrapper import BatchEnsemble

REAL, ANGLE = Target("real", ("x",)), Target("angle", ("azimuth",))
MLP = {"name": "mlp", "widths": [8, 5]}
VGG = {"name": "biternion_vgg", "channels": [3] * 6, "features": 12}


def model(encoder, target=REAL, head="gaussian", shape=(4,)):
    torch.manual_seed(0)
    built = build("encoder", resolve("encoder", encoder), input_shape=shape)
    return Model([built], build("density_head", resolve("density_head", head), target=target))


def member_of(wrapper, number):
    """Return a plain model with the weights of one member."""
    alone = copy.deepcopy(wrapper.model)
    for module in list(alone.modules()):
        for name, child in list(module.named_children()):
            if isinstance(child, RankOne):
                layer = child.layer
                inputs, outputs = 1 + child.input_factors[number], 1 + child.output_factors[number]
                shape = (1,) * (layer.weight.dim() - 2)
                factors = (outputs[:, None] * inputs).view(*layer.weight.shape[:2], *shape)
                layer.weight = nn.Parameter((layer.weight * factors).detach())
                layer.bias = (
                    None if child.biases is None else nn.Parameter(child.biases[number].detach().clone())
                )
                setattr(module, name, layer)
    return alone


def case(kind):
    if kind == "mlp":
        return model(MLP), torch.randn(6, 4), torch.randn(6, 1)
    images = torch.rand(6, 1, 32, 32)
    return model(VGG, ANGLE, "von_mises", (1, 32, 32)), images, torch.randn(6, 1)


@pytest.mark.parametrize("kind", ["mlp", "convolutions"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_density_is_the_mean_over_models_with_the_members_weights(kind, dtype):
    inner, inputs, target = case(kind)
    wrapper = BatchEnsemble(lambda: inner, members=3).to(dtype).eval()
    inputs, target = inputs.to(dtype), target.to(dtype)
    with torch.no_grad():
        expected = torch.stack(
            [member_of(wrapper, number)(inputs).log_prob(target).exp() for number in range(3)]
        )
        assert expected.std(0).max() > 1e-3
        torch.testing.assert_close(
            wrapper(inputs).log_prob(target).exp(), expected.mean(0), rtol=1e-4, atol=1e-5
        )
        torch.testing.assert_close(
            wrapper.training_densities(inputs).log_prob(target.unsqueeze(1)).exp(),
            expected.T,
            rtol=1e-4,
            atol=1e-5,
        )
        wrapper.members = 2
        torch.testing.assert_close(
            wrapper(inputs).log_prob(target).exp(), expected[:2].mean(0), rtol=1e-4, atol=1e-5
        )


def test_the_loss_is_the_mean_over_members():
    inner, inputs, target = case("mlp")
    wrapper = BatchEnsemble(lambda: inner, members=4).eval()
    expected = torch.stack([member_of(wrapper, number).loss(inputs, target) for number in range(4)]).mean(0)
    torch.testing.assert_close(wrapper.loss(inputs, target), expected)


@pytest.mark.parametrize("kind", ["mlp", "convolutions"])
def test_one_member_is_the_model_to_the_last_bit(kind):
    inner, inputs, target = case(kind)
    alone = copy.deepcopy(inner)
    wrapper = BatchEnsemble(lambda: inner, members=1)
    for predictor in (wrapper, alone):
        predictor.train()
        torch.manual_seed(3)
        predictor.loss(inputs, target).mean().backward()
    for mine, other in zip(wrapper.parameters(), alone.parameters(), strict=True):
        assert torch.equal(mine.grad, other.grad)
    with torch.no_grad():
        assert torch.equal(wrapper.eval()(inputs).log_prob(target), alone.eval()(inputs).log_prob(target))


def test_a_calibrated_head_sees_all_members():
    inner = model(MLP, head={"name": "gaussian", "scale": "fixed"})
    wrapper = BatchEnsemble(lambda: inner, members=3).eval()
    inputs, target = torch.randn(40, 4), torch.randn(40, 1)
    wrapper.calibrate(
        [{"input": inputs[:25], "target": target[:25]}, {"input": inputs[25:], "target": target[25:]}]
    )
    with torch.no_grad():
        means = torch.cat([member_of(wrapper, number)(inputs).mean for number in range(3)])
    deviation = (means - target.repeat(3, 1)).square().mean().sqrt()
    torch.testing.assert_close(inner.head.scale.squeeze().float(), deviation.float(), rtol=1e-3, atol=0)


def test_few_parameters_are_added():
    wrapper = BatchEnsemble(lambda: model({"name": "mlp", "widths": [100, 100]}), members=10)
    plain = sum(part.numel() for part in model({"name": "mlp", "widths": [100, 100]}).parameters())
    count = sum(part.numel() for part in wrapper.parameters())
    # factors of the inputs and outputs of 4 → 100 → 100 → 2, and the biases
    assert count == plain - 202 + 10 * (4 + 100 + 100 + 2 * 202)


class Points(Encoder):
    """An encoder that applies its layer to the points of all clouds as one batch."""

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(2, 3)
        self.output_shape = (3,)

    def forward(self, inputs):
        return self.layer(inputs.flatten(0, 1)).unflatten(0, inputs.shape[:2]).mean(1)


def test_models_that_cannot_have_members_are_refused():
    head = build("density_head", resolve("density_head", "gaussian"), target=REAL)
    with pytest.raises(
        ConfigError, match="keep one row for each input, but a layer got 60 rows for 15 inputs"
    ):
        BatchEnsemble(lambda: Model([Points()], head), members=3)(torch.randn(5, 4, 2))
    with pytest.raises(ConfigError, match="has no such layer"):
        BatchEnsemble(lambda: model({"name": "mlp", "widths": []}, head="extra_trees"))
    with pytest.raises(ConfigError, match=r"Put batch_ensemble first"):
        BatchEnsemble(lambda: BatchEnsemble(lambda: model(MLP)))
    wrapper = BatchEnsemble(lambda: model(MLP))
    wrapper.members = 6
    with pytest.raises(ConfigError, match="expected a number from 1 to 5"):
        wrapper(torch.zeros(2, 4))


@pytest.mark.parametrize("config", [{"members": 0}, {"spread": 0.0}])
def test_a_config_out_of_range_is_refused(config):
    with pytest.raises(ConfigError, match=r"uncertainty\."):
        resolve("uncertainty", {"name": "batch_ensemble", **config})
