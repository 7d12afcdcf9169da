import math
from typing import ClassVar

import numpy as np
import pytest
import torch
from torch import nn
from torch.distributions import Categorical, Independent, Normal
from torch.distributions import kl_divergence as torch_kl_divergence

from framework.configuration.assembly import build_predictor
from framework.configuration.schema import build, resolve
from framework.density_head import DensityHead
from framework.distributions.density import Mixture
from framework.distributions.protocol import estimate, marginal
from framework.errors import ConfigError
from framework.target import Target
from framework.testing.densities import integral, marginals, median_is_best, samples_follow_log_prob
from framework.testing.finding import require, run_check
from framework.testing.head_subject import values
from plugins.density_head.latent import density as module
from plugins.density_head.latent.cvae import (
    CVAEHead,
    Gaussian,
    evidence_bound,
    importance_log_weights,
    kl_divergence,
)
from plugins.density_head.latent.head import LatentSettings
from plugins.density_head.latent.rows import ONE, SMALL, TWO


def test_each_network_may_have_a_backbone_of_its_own():
    """Check that each part of the raw parameters has its own backbone, and that the loss depends on these alone."""
    config = {
        "data": "moons",
        "density_head": {"name": "cvae", **SMALL, "backbones": "each"},
        "encoder": {"mlp": {"name": "mlp", "widths": [5]}},
    }
    model = build_predictor({**resolve_all_parts(config)}, ONE, (4,), 0).double()
    shared = {**config, "density_head": {"name": "cvae", **SMALL}}
    shared_model = build_predictor(resolve_all_parts(shared), ONE, (4,), 0).double()
    counts = [
        sum(parameter.numel() for parameter in predictor.encoders.parameters())
        for predictor in (model, shared_model)
    ]
    assert counts[0] == 3 * counts[1] + sum(5 * part + part for part in model.head.backbones)
    networks = model.encoders[0].networks
    assert not torch.equal(networks[0][0].layers[0].weight, networks[1][0].layers[0].weight)
    inputs = torch.randn(3, 4, dtype=torch.float64)
    raw = model.raw(inputs)
    for index, part in enumerate(raw.split(model.head.backbones, -1)):
        gradients = torch.autograd.grad(part.sum(), list(networks.parameters()), retain_graph=True)
        per_network = len(gradients) // 3
        moved = [
            any(bool(gradient.any()) for gradient in gradients[at * per_network : (at + 1) * per_network])
            for at in range(3)
        ]
        assert moved == [at == index for at in range(3)]
    target = torch.randn(3, 1, dtype=torch.float64)
    torch.manual_seed(0)
    loss = model.loss(inputs, target)
    same = build_head()
    same.load_state_dict(model.head.state_dict())
    torch.manual_seed(0)
    torch.testing.assert_close(same.double().loss(raw, target), loss, rtol=0, atol=0)
    with pytest.raises(ConfigError, match="but only the head of a model has networks"):
        component = {"name": "cvae", **SMALL, "backbones": "each"}
        build(
            "density_head", resolve("density_head", {"name": "mixture", "component": component}), target=ONE
        )


def resolve_all_parts(config):
    """Resolve the parts that `build_predictor` reads."""
    encoders = [resolve("encoder", settings) for settings in config["encoder"].values()]
    return {
        "encoder": encoders,
        "density_head": resolve("density_head", config["density_head"]),
        "uncertainty": [],
    }


def build_head(config=SMALL, target=ONE):
    torch.manual_seed(12)
    return build("density_head", resolve("density_head", {"name": "cvae", **config}), target=target)


class NormalHead(DensityHead):
    """Independent normal densities, for targets that are not angles."""

    knobs: ClassVar = {}
    bibtex = ""

    def __init__(self, target):
        super().__init__()
        self.size = 2 * len(target.names)

    def forward(self, raw):
        mean, scale = raw.chunk(2, -1)
        return Independent(Normal(mean, 0.1 + nn.functional.softplus(scale), validate_args=False), 1, False)

    def loss(self, raw, target):
        return -self(raw).log_prob(target)

    def calibrate(self, raw, target):
        pass


class CategoricalHead(NormalHead):
    """A head of class probabilities."""

    def __init__(self, target):
        super().__init__(target)
        self.size = len(target.names)

    def forward(self, raw):
        return Categorical(logits=raw, validate_args=False)


def raws(head, *batch):
    return torch.randn(*batch, head.size, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize(
    "target, component",
    [(Target("real", ("x", "y")), NormalHead), (Target("class", ("a", "b", "c")), CategoricalHead)],
)
def test_targets_that_are_not_angles(target, component):
    head = CVAEHead(target, settings=LatentSettings(**SMALL), component=component(target)).eval()
    raw, value = raws(head, 4), values(target, (4,))
    with torch.no_grad():
        density = head(raw)
        assert density.log_prob(value).shape == (4,)
        assert density.sample((6,)).shape == (6, *value.shape)
    head.train().loss(raw, value).sum().backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in head.parameters())


@pytest.mark.parametrize("target", [ONE, TWO])
def test_the_mixture_is_a_density_that_samples_follow(target):
    head = build_head(target=target).double().eval()
    with torch.no_grad():
        density = head(raws(head, 3).double())  # κ small enough for the grids
        checks = [(integral, 1e-6), (samples_follow_log_prob, 5.0)]
        checks += [(marginals, 1e-6)] if target is TWO else [(median_is_best, 5.0)]
        for check, limit in checks:
            require(
                run_check(check.__name__, limit, lambda worst, check=check: check(density.mixture, worst))
            )
        assert isinstance(marginal(density, 0), Mixture)


# one latent dimension, where the integral (eq. 3.12) is a sum


@pytest.fixture
def toy():
    head = build_head({**SMALL, "latent": 1}).double().eval()
    head.requires_grad_(False)
    raw = raws(head, 3).double()
    networks = head.networks(raw)
    # not so far out that a few rare z dominate the integral
    value = networks.component(networks.decode(networks.prior.mean)).mode + 0.3
    return head, networks, raw, value


def truth(networks, value):
    """Return log ∫ p(φ|x,z) p(z|x) dz by the trapezium rule over ±10 standard deviations."""
    standard = torch.linspace(-10, 10, 4001, dtype=torch.float64)[:, None, None]
    z = networks.prior.mean + networks.prior.log_scale.exp() * standard
    weight = Normal(0, 1).log_prob(standard[..., 0]) + math.log(20 / 4000)
    likelihood = networks.component(networks.decode(z)).log_prob(value)
    return torch.logsumexp(likelihood + weight, 0)


def test_bounds_rise_to_the_integral(toy):
    _, networks, _, value = toy
    exact = truth(networks, value)
    torch.manual_seed(0)
    repeats = 4000
    bounds = [torch.stack([evidence_bound(networks, value, 10) for _ in range(400)])]
    for samples in (1, 10, 100):
        noise = torch.randn(samples, repeats, 3, 1, dtype=torch.float64)
        weights = importance_log_weights(networks, value.expand(repeats, 3, 1), noise)
        bounds.append(torch.logsumexp(weights, 0) - math.log(samples))
    means = torch.stack([bound.mean(0) for bound in bounds])
    noise = torch.stack([bound.std(0) / len(bound) ** 0.5 for bound in bounds])
    # the bound with one proposal is the evidence bound (eq. 3.16)
    assert ((means[0] - means[1]).abs() < 4 * (noise[0] + noise[1])).all()
    assert (means[2:] > means[1:-1] + 4 * noise[1:-1]).all()
    assert (means < exact + 4 * noise).all()
    assert ((exact - means[3]) < 0.1 * (exact - means[1])).all()


def test_log_prob_with_many_samples_is_the_integral(toy):
    head, networks, raw, value = toy
    head.samples = 20_000
    torch.manual_seed(0)
    assert (head(raw).log_prob(value) - truth(networks, value)).abs().max() < 0.02
    assert (head(raw).mixture.log_prob(value) - truth(networks, value)).abs().max() < 0.02


@pytest.mark.parametrize("tolerance", [0.1, 0.01, 0.001])
def test_the_tolerance_is_reached(toy, tolerance):
    head, networks, raw, value = toy
    head.samples, head.tolerance = 64, tolerance
    estimates = []
    for seed in range(60):
        torch.manual_seed(seed)
        estimates.append(estimate(head(raw), value))
    error = (torch.stack([result.log_mean for result in estimates]) - truth(networks, value)).abs()
    assert (error < tolerance).double().mean() > 0.75
    assert (error < 3 * tolerance).double().mean() > 0.95
    assert not any(result.unresolved.any() for result in estimates)


def test_one_density_is_a_function_of_the_value(toy):
    head, _, raw, value = toy
    for tolerance in (None, 0.05):
        head.tolerance = tolerance
        density = head(raw)
        first = density.log_prob(value)
        density.sample((2,))
        assert torch.equal(density.log_prob(value), first)
        torch.testing.assert_close(density.log_prob(value + 2 * math.pi), first, rtol=1e-12, atol=1e-12)
        several = value.expand(4, 3, 1)
        torch.testing.assert_close(density.log_prob(several), first.expand(4, 3), rtol=1e-12, atol=1e-12)
        assert torch.autograd.gradcheck(density.log_prob, value.clone().requires_grad_())


def test_samples_follow_the_integral(toy):
    head, networks, raw, _ = toy
    torch.manual_seed(0)
    samples = head(raw).sample((20_000,))
    cosine = samples.cos().mean(0)[:, 0]
    angles = torch.linspace(-math.pi, math.pi, 361, dtype=torch.float64)[:-1]
    mass = torch.stack([truth(networks, angle.expand(3, 1)) for angle in angles]).exp() * (2 * math.pi / 360)
    torch.testing.assert_close(mass.sum(0), torch.ones(3).double(), rtol=1e-6, atol=0)
    assert (cosine - (mass * angles.cos()[:, None]).sum(0)).abs().max() < 4 * 0.71 / 20_000**0.5


def test_gaussians_agree_with_torch():
    generator = torch.Generator().manual_seed(0)
    numbers = torch.randn(4, 5, 3, generator=generator, dtype=torch.float64)
    first, second = Gaussian(numbers[0], numbers[1]), Gaussian(numbers[2], numbers[3])
    ours, theirs = (Independent(Normal(g.mean, g.log_scale.exp()), 1) for g in (first, second))
    torch.testing.assert_close(kl_divergence(first, second), torch_kl_divergence(ours, theirs))
    torch.testing.assert_close(second.log_prob(numbers[0]), theirs.log_prob(numbers[0]))
    assert (kl_divergence(first, first) == 0).all()


def test_the_samples_may_be_set_at_any_time_and_training_has_its_own():
    head = build_head()
    raw = raws(head, 2)
    assert head.train()(raw).mixture.log_weights.shape == (2, 5)
    head.eval().samples = 3
    assert head(raw).mixture.log_weights.shape == (2, 3)
    assert head(raw).mixture.components.batch_shape == (2, 3)


def test_memory_is_bounded(monkeypatch):
    head = build_head(target=TWO).eval()
    raw, grid = raws(head, 6), values(TWO, (40, 6))
    sizes = []
    head.decoder.body[1].register_forward_hook(lambda layer, arguments, output: sizes.append(output.numel()))
    results = []
    with torch.no_grad():
        for chunk in (module.CHUNK, 500):
            monkeypatch.setattr(module, "CHUNK", chunk)
            torch.manual_seed(0)
            density = head(raw)
            sizes.clear()
            results.append([density.mixture.log_prob(grid), density.log_prob(grid), density.sample((40,))])
    assert max(sizes) <= 500
    for first, second in zip(*results, strict=True):
        assert first.shape == second.shape
    torch.testing.assert_close(results[0][:2], results[1][:2])


def test_a_component_that_is_fitted_afterwards_is_refused():
    with pytest.raises(ConfigError, match="fits concentration after training"):
        build_head({"component": {"name": "von_mises", "concentration": "fixed"}})


def test_what_the_encoder_sees():
    head = build_head(target=TWO)
    value = torch.tensor([[0.5, -2.0]])
    expected = np.r_[np.cos([0.5, -2.0]), np.sin([0.5, -2.0])]
    np.testing.assert_allclose(head.encode(value)[0], expected, rtol=1e-6)
    torch.testing.assert_close(head.encode(value + 2 * math.pi), head.encode(value), rtol=0, atol=1e-6)
