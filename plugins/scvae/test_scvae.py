import math

import numpy as np
import pytest
import torch
from scipy import special, stats

from framework import testing
from framework.density import marginal
from framework.errors import ConfigError
from framework.schema import build, resolve
from framework.target import Target
from plugins.scvae import head as module

ONE, TWO = Target("angle", ("azimuth",)), Target("angle", ("azimuth", "elevation"))
SMALL = {"latent": 2, "hidden": 16, "training_samples": 5, "samples": 50}
ROWS = [
    (SMALL, ONE),
    (SMALL, TWO),
    ({**SMALL, "samples": 1, "training_samples": 1}, ONE),
    ({**SMALL, "component": {"name": "mixture", "components": 2}}, ONE),
]


def head(config=SMALL, target=ONE):
    torch.manual_seed(11)
    return build("density_head", resolve("density_head", {"name": "scvae", **config}), target=target)


@pytest.mark.parametrize("config, target", ROWS)
def test_contract(config, target):
    testing.check_head(lambda: head(config, target), target)


@pytest.mark.parametrize("config, target", ROWS)
def test_density(config, target):
    made = head(config, target).eval()
    with torch.no_grad():
        density = made(testing.raws(made, (3,)))  # κ that the grids resolve
        alone = marginal(density, 0)
        testing.check_normalised(alone)
        testing.check_median(alone, limit=0.02)  # of 2000 samples
        testing.check_samples(alone)
        if target is TWO:
            testing.check_normalised(density, points=256)
            testing.check_samples(density, points=252)
            testing.check_marginal(density, points=256)


def test_log_prob_agrees_with_a_loop_over_items_and_samples():
    made = head({**SMALL, "latent": 3}, TWO).double().eval()
    raw, value = 3 * testing.raws(made, (4,)).double(), testing.values(TWO, (4,)).double()
    torch.manual_seed(5)
    density = made(raw)
    torch.manual_seed(5)
    z = torch.randn(4, 50, 3, dtype=torch.float64)
    expected = np.empty(4)
    for item in range(4):
        log_probs = []
        for sample in range(50):
            numbers = made.decoder(raw[item], z[item, sample]).detach().numpy()
            total = 0.0
            for angle, (cosine, sine, scale) in enumerate(numbers.reshape(2, 3)):
                kappa = made.component.floor + math.hypot(cosine, sine) * (
                    math.exp(scale) if scale < 0 else (1 + scale / 4) ** 4
                )
                total += stats.vonmises.logpdf(value[item, angle].item(), kappa, math.atan2(sine, cosine))
            log_probs.append(total)
        expected[item] = special.logsumexp(log_probs) - math.log(50)  # eq. 3.21
    testing.check_log_prob(density, value, torch.from_numpy(expected), limit=1e-12)


def test_many_samples_approach_the_integral_over_the_latent():
    made = head({**SMALL, "latent": 1, "samples": 20_000}).double().eval()
    raw, value = testing.raws(made, (3,)).double(), testing.values(ONE, (3,)).double()
    points, weights = np.polynomial.hermite_e.hermegauss(180)
    with torch.no_grad():
        z = torch.from_numpy(points)[:, None].expand(3, -1, 1)
        at_points = made.component(made.decode(raw, z)).log_prob(value[:, None])
        weights = torch.from_numpy(np.log(weights / weights.sum()))
        truth = torch.logsumexp(at_points + weights, -1)
        second_moment = torch.logsumexp(2 * at_points + weights, -1)
        noise = (torch.expm1(second_moment - 2 * truth) / made.samples).sqrt()  # standard error of log p
        torch.manual_seed(0)
        assert ((made(raw).log_prob(value) - truth).abs() < 4 * noise).all()
        assert noise.max() < 0.1


def test_the_samples_may_be_set_at_any_time_and_training_has_its_own():
    made = head()
    raw = testing.raws(made, (2,))
    assert made.train()(raw).log_weights.shape == (2, 5)
    assert made.eval()(raw).log_weights.shape == (2, 50)
    made.samples = 3
    assert made(raw).log_weights.shape == (2, 3)


def test_memory_is_bounded_and_the_bound_changes_nothing(monkeypatch):
    made = head(target=TWO).eval()
    raw, value = testing.raws(made, (6,)), testing.values(TWO, (6,))
    held = []
    made.decoder.body[1].register_forward_hook(lambda layer, arguments, output: held.append(output.numel()))
    found = []
    with torch.no_grad():
        for chunk in (module.CHUNK, 500):
            monkeypatch.setattr(module, "CHUNK", chunk)
            torch.manual_seed(0)
            found.append(made(raw).log_prob(value))
    assert max(held[1:]) <= 500 < held[0]
    torch.testing.assert_close(*found)


def test_every_parameter_is_trained():
    made = head().train()
    made.loss(testing.raws(made, (64,)), testing.values(ONE, (64,))).sum().backward()
    for name, parameter in made.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_a_component_that_is_fitted_afterwards_is_refused():
    with pytest.raises(ConfigError, match="fits concentration after training"):
        head({"component": {"name": "von_mises", "concentration": "fixed"}})
