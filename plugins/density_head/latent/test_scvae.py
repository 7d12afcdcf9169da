import math

import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.distributions.circular import grid
from framework.distributions.density import Mixture
from framework.distributions.protocol import estimate
from framework.errors import ConfigError
from framework.testing.head_subject import values
from plugins.density_head.latent import density as module
from plugins.density_head.latent.rows import ONE, SMALL, TWO


def build_head(config=SMALL, target=ONE):
    torch.manual_seed(11)
    return build("density_head", resolve("density_head", {"name": "scvae", **config}), target=target)


def raws(head, *batch):
    return torch.randn(*batch, head.size, generator=torch.Generator().manual_seed(1))


def integral(head, raw, value):
    """Return log ∫ p(φ|x,z) N(z; 0, 1) dz and log ∫ p² N dz for one latent dimension.

    They are computed by the trapezium rule over ±9: the kinks of the rectifiers cost Gauss-Hermite quadrature 0.03
    nats.
    """
    z = torch.linspace(-9, 9, 10_001, dtype=torch.float64)[:, None].expand(len(raw), -1, 1)
    at_points = head.component(head.decode(raw, z)).log_prob(value[:, None])
    weight = -z[..., 0].square() / 2 + math.log(18 / 10_000) - math.log(2 * math.pi) / 2
    return torch.logsumexp(at_points + weight, -1), torch.logsumexp(2 * at_points + weight, -1)


def test_many_samples_approach_the_integral_over_the_latent():
    head = build_head({**SMALL, "latent": 1, "samples": 20_000}).double().eval()
    raw, value = raws(head, 3).double(), values(ONE, (3,)).double()
    with torch.no_grad():
        truth, second_moment = integral(head, raw, value)
        noise = (torch.expm1(second_moment - 2 * truth) / head.samples).sqrt()  # of independent samples
        torch.manual_seed(0)
        assert ((head(raw).log_prob(value) - truth).abs() < 4 * noise).all()
        assert noise.max() < 0.1


def test_the_tolerance_is_reached():
    head = build_head({**SMALL, "latent": 1, "samples": 64}).double().eval()
    raw, value = raws(head, 40).double(), values(ONE, (40,)).double()
    with torch.no_grad():
        truth, _ = integral(head, raw, value)
        for tolerance in (0.1, 0.01, 0.001):
            head.tolerance = tolerance  # it may be set at any time
            estimates = []
            for seed in range(5):
                torch.manual_seed(seed)
                estimates.append(estimate(head(raw), value))
            error = (torch.stack([result.log_mean for result in estimates]) - truth).abs()
            assert (error < tolerance).double().mean() > 0.68  # a standard error's share
            assert (error < 3 * tolerance).double().mean() > 0.95
            assert not any(result.unresolved.any() for result in estimates)
    head.tolerance = None
    assert isinstance(head(raw), Mixture)
    head.tolerance = -1.0
    with pytest.raises(ConfigError, match="expected a number above 0"):
        head(raw)


def test_an_estimate_to_a_tolerance_has_a_gradient():
    head = build_head({**SMALL, "latent": 1, "tolerance": 0.05}).double().eval()
    density = head(raws(head, 2).double().detach())
    value = values(ONE, (3, 2)).double().requires_grad_()
    assert density.log_prob(value).shape == (3, 2)
    assert torch.autograd.gradcheck(density.log_prob, value)


def test_samples_of_either_density_are_those_of_the_integral():
    head = build_head({**SMALL, "latent": 1, "samples": 2000}).double().eval()
    raw = raws(head, 3).double()
    angles = grid(90, dtype=torch.float64)
    with torch.no_grad():
        mass = (
            torch.stack([integral(head, raw, angle.expand(3, 1))[0] for angle in angles]).exp()
            * 2
            * math.pi
            / 90
        )
        torch.testing.assert_close(mass.sum(0), torch.ones(3).double(), rtol=1e-6, atol=0)
        for tolerance in (None, 0.01):
            head.tolerance = tolerance
            torch.manual_seed(0)
            cosine = head(raw).sample((20_000,)).cos().mean(0)[:, 0]
            # 20,000 draws, and 2000 components of them
            assert (
                cosine - (mass * angles.cos()[:, None]).sum(0)
            ).abs().max() < 4 * 0.71 / 20_000**0.5 + 0.005


def test_the_samples_may_be_set_at_any_time_and_training_has_its_own():
    head = build_head()
    raw = raws(head, 2)
    assert head.train()(raw).log_weights.shape == (2, 5)
    assert head.eval()(raw).log_weights.shape == (2, 50)
    head.samples = 3
    assert head(raw).log_weights.shape == (2, 3)


def test_memory_is_bounded_and_the_bound_changes_nothing(monkeypatch):
    head = build_head(target=TWO).eval()
    raw, value = raws(head, 6), values(TWO, (6,))
    sizes, most = [], []
    head.decoder.body[1].register_forward_hook(lambda layer, arguments, output: sizes.append(output.numel()))
    results = []
    with torch.no_grad():
        for chunk in (module.CHUNK, 600):  # one sample of each of 32 replicates holds 512
            monkeypatch.setattr(module, "CHUNK", chunk)
            torch.manual_seed(0)
            head.tolerance = None
            several = [head(raw).log_prob(value)]
            head.tolerance = 0.05
            density = head(raw)
            several += [density.log_prob(value), density.mixture.log_prob(value), density.sample((3,)).cos()]
            results.append(several)
            most.append(max(sizes))
            sizes.clear()
    assert most[1] <= 600 < most[0]
    for first, second in zip(*results, strict=True):
        torch.testing.assert_close(first, second, rtol=1e-4, atol=1e-4)


def test_every_parameter_is_trained():
    head = build_head().train()
    head.loss(raws(head, 64), values(ONE, (64,))).sum().backward()
    for name, parameter in head.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_a_component_that_is_fitted_afterwards_is_refused():
    with pytest.raises(ConfigError, match="fits concentration after training"):
        build_head({"component": {"name": "von_mises", "concentration": "fixed"}})
