import math

import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.distributions.circular import Circular
from framework.distributions.uniform import uniform
from framework.errors import ConfigError, UserError
from framework.target import Target
from plugins.density_head.uniform_floor.rows import CLASSES, ONE, THREE


def build_head(config, target):
    return build("density_head", resolve("density_head", {"name": "uniform_floor", **config}), target=target)


@pytest.mark.parametrize("target, volume", [(ONE, 2 * math.pi), (THREE, (2 * math.pi) ** 3), (CLASSES, 3)])
def test_log_prob_is_the_weighted_sum(target, volume):
    component = {"name": "categorical"} if target is CLASSES else {"name": "von_mises"}
    head = build_head({"weight": 0.2, "component": component}, target)
    raw = torch.randn(50, head.size)
    value = torch.randint(3, (50,)) if target is CLASSES else 3 * torch.randn(50, len(target.names))
    wanted = (0.8 * head.component(raw).log_prob(value).exp() + 0.2 / volume).log()
    torch.testing.assert_close(head(raw).log_prob(value), wanted)
    torch.testing.assert_close(head.loss(raw, value), -wanted)


@pytest.mark.parametrize(
    "component", ["matrix_fisher", {"name": "mixture", "component": {"name": "matrix_fisher"}}]
)
def test_under_rotations_lies_their_own_uniform_law(component):
    """Check the floor cos e / 8π² in the density, in the loss, and in samples, half of which are uniform."""
    config = {"weight": 0.5, "component": component if isinstance(component, dict) else {"name": component}}
    head = build_head(config, THREE).double()
    torch.manual_seed(0)
    raw, value = torch.randn(50, head.size).double(), head(torch.randn(50, head.size).double()).sample()
    haar = value[:, 1].cos() / (8 * math.pi**2)
    wanted = (0.5 * head.component(raw).log_prob(value).exp() + 0.5 * haar).log()
    torch.testing.assert_close(head(raw).log_prob(value), wanted)
    torch.testing.assert_close(head.loss(raw, value), -wanted)
    elevation = head(torch.zeros_like(raw[:1]) if component == "matrix_fisher" else raw[:1]).sample(
        (20_000,)
    )[..., 1]
    assert elevation.abs().max() <= math.pi / 2
    if component == "matrix_fisher":  # all uniform: sin e is, with variance 1/3
        assert elevation.sin().square().mean().item() == pytest.approx(1 / 3, abs=0.01)


def test_a_support_without_a_uniform_law_is_refused():
    class Part(torch.distributions.Uniform):
        support = Circular(((0.0, 1.0),))

    with pytest.raises(UserError, match=r"no uniform distribution.*uniform\.register"):
        uniform(torch.distributions.Independent(Part(torch.zeros(2, 1), torch.ones(2, 1)), 1))
    real = torch.distributions.Independent(torch.distributions.Normal(torch.zeros(2, 1), torch.ones(2, 1)), 1)
    with pytest.raises(UserError, match="no uniform distribution"):
        uniform(real)


def test_without_weight_it_is_its_component_to_the_last_bit():
    head = build_head({"weight": 0.0}, THREE)
    raw, value = torch.randn(8, head.size), torch.randn(8, 3)
    assert torch.equal(head(raw).log_prob(value), head.component(raw).log_prob(value))
    assert torch.equal(head.loss(raw, value), head.component.loss(raw, value))


def test_an_outlier_costs_no_more_than_the_floor_and_pulls_at_nothing():
    head = build_head({"weight": 1e-3}, ONE)
    raw = torch.tensor([[1e12, 0.0, 1e3]], requires_grad=True)
    loss = head.loss(raw, torch.tensor([[3.0]]))
    loss.sum().backward()
    assert loss.item() == pytest.approx(math.log(2 * math.pi / 1e-3))
    assert torch.equal(raw.grad, torch.zeros(1, 3))


def test_samples_of_classes_reach_every_class():
    head = build_head({"weight": 0.3, "component": {"name": "categorical"}}, CLASSES)
    torch.manual_seed(0)
    samples = head(torch.tensor([[100.0, 0.0, 0.0]])).sample((9000,))
    assert (samples == 2).double().mean().item() == pytest.approx(0.1, abs=4 * 0.3 / 9000**0.5)


def test_reals_have_no_uniform_density():
    with pytest.raises(ConfigError, match="no density is uniform over the reals"):
        build_head({"component": {"name": "gaussian"}}, Target("real", ("x",)))


@pytest.mark.parametrize("weight", [-0.1, 1.0, float("nan")])
def test_a_weight_out_of_range_is_refused(weight):
    with pytest.raises(ConfigError, match=r"density_head\.weight"):
        build_head({"weight": weight}, ONE)
