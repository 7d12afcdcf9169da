import math

import numpy as np
import pytest
import torch
from scipy import special, stats

from framework import testing
from framework.density import Mixture, marginal
from framework.errors import ConfigError
from framework.schema import build, resolve
from framework.target import Target

ONE, TWO = Target("angle", ("azimuth",)), Target("angle", ("azimuth", "elevation"))
ROWS = [({}, ONE), ({"components": 1}, ONE), ({"components": 3}, TWO)]
NESTED = {"components": 2, "component": {"name": "mixture", "components": 3}}


def head(config, target):
    return build("density_head", resolve("density_head", {"name": "mixture", **config}), target=target)


@pytest.mark.parametrize("config, target", [*ROWS, (NESTED, ONE)])
def test_contract(config, target):
    testing.check_head(lambda: head(config, target), target)


@pytest.mark.parametrize("config, target", ROWS)
def test_density(config, target):
    made = head(config, target).eval()
    with torch.no_grad():
        density = made(3 * testing.raws(made, (3,)))
        alone = marginal(density, 0)
        testing.check_normalised(alone)
        testing.check_median(alone, limit=0.02)  # of 2000 samples
        testing.check_samples(alone)
        testing.check_periodic(
            made.double()(testing.raws(made, (3,)).double()),
            testing.values(target, (3,)).double(),
            limit=1e-9,
        )
        if target is TWO:
            testing.check_normalised(density, points=512)
            testing.check_samples(density, points=504)
            testing.check_marginal(density, points=256)


@pytest.mark.parametrize("config, target", ROWS)
def test_log_prob_is_the_weighted_sum(config, target):
    made = head(config, target).double()
    count, each = made.components, 3 * len(target.names)
    raw, value = testing.raws(made, (5,)).double(), testing.values(target, (5,)).double()
    weights = special.softmax(raw[:, :count].numpy(), -1)
    numbers = raw[:, count : count + count * each].numpy().reshape(5, count, each)
    if count > 1:
        numbers = numbers + raw[:, -each:].numpy()[:, None] + made.spread.detach().numpy()
    total = np.zeros(5)
    for row, component in np.ndindex(5, count):
        product = weights[row, component]
        for angle, (cosine, sine, scale) in enumerate(numbers[row, component].reshape(-1, 3)):
            growth = math.exp(scale) if scale < 0 else (1 + scale / 4) ** 4
            kappa = made.component.floor + math.hypot(cosine, sine) * growth
            product *= stats.vonmises.pdf(value[row, angle].item(), kappa, math.atan2(sine, cosine))
        total[row] += product
    testing.check_log_prob(made(raw), value, torch.from_numpy(np.log(total)), limit=1e-12)


def test_one_component_is_the_component_to_the_last_bit():
    made = head({"components": 1}, TWO)
    raw, value = testing.raws(made, (7,)), testing.values(TWO, (7,))
    density, component = made(raw), made.component(raw[:, 1:])
    assert torch.equal(density.log_prob(value), component.log_prob(value))
    assert torch.equal(density.entropy(), component.entropy())
    assert torch.equal(density.mode, component.mode)


def test_a_mixture_of_mixtures_is_a_mixture():
    made = head(NESTED, ONE)
    value = testing.values(ONE, (4,))
    outer = made(testing.raws(made, (4,)))
    inner = outer.components
    weights = (outer.log_weights[..., None] + inner.log_weights).flatten(-2)
    leaf = inner.components
    leaves = type(leaf)(leaf.mean.flatten(1, 2), leaf.concentration.flatten(1, 2))
    torch.testing.assert_close(outer.log_prob(value), Mixture(weights, leaves).log_prob(value))


def test_a_weight_that_vanishes_leaves_a_finite_loss():
    made = head({"components": 2}, ONE)
    raw = torch.tensor([[3e38, -3e38, 1.0, 0, 50, -1, 0, 50, 0, 0, 0]], requires_grad=True)
    loss = made.loss(raw, torch.tensor([[math.pi]]))
    loss.backward()
    assert loss.isfinite() and raw.grad.isfinite().all()


def test_a_component_that_is_fitted_afterwards_is_refused():
    with pytest.raises(ConfigError, match="fits concentration after training"):
        head({"component": {"name": "von_mises", "concentration": "fixed"}}, ONE)


def test_another_target_is_refused_by_the_component():
    with pytest.raises(ConfigError, match="von_mises"):
        head({}, Target("real", ("height",)))
