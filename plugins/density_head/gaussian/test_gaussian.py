import math

import numpy as np
import pytest
import torch
from scipy import stats

from framework.configuration.schema import build, resolve
from framework.distributions.protocol import marginal, pick, quadratic_bound
from framework.errors import ConfigError
from framework.target import Target
from plugins.density_head.gaussian.density import Gaussian
from plugins.density_head.gaussian.head import scale_of_raw
from plugins.density_head.gaussian.rows import ONE, THREE


def build_head(config=None, target=THREE):
    return build(
        "density_head", resolve("density_head", {"name": "gaussian", **(config or {})}), target=target
    )


@pytest.fixture
def full():
    """Return a batch of full Gaussians in float64, and their covariances by inversion."""
    torch.manual_seed(0)
    density = build_head({"covariance": "full"}).double()(torch.randn(5, 9, dtype=torch.float64))
    inverse = np.linalg.inv(np.eye(3) - density.coefficients.numpy())
    return density, inverse @ (density.scale.numpy()[:, :, None] ** 2 * inverse.transpose(0, 2, 1))


def test_full_covariance_agrees_with_scipy(full):
    density, covariance = full
    value = torch.randn(5, 3, dtype=torch.float64)
    for row in range(5):
        wanted = stats.multivariate_normal(density.mean[row].numpy(), covariance[row])
        assert density.log_prob(value)[row].item() == pytest.approx(
            wanted.logpdf(value[row].numpy()), rel=1e-10
        )
        assert density.entropy()[row].item() == pytest.approx(wanted.entropy(), rel=1e-10)
    np.testing.assert_allclose(density.variance.numpy(), np.einsum("bii->bi", covariance), rtol=1e-12)


def test_samples_have_the_covariance(full):
    density, covariance = full
    torch.manual_seed(1)
    samples = density.sample((40_000,)).numpy()
    scale = np.sqrt(np.einsum("bii->bi", covariance))
    for row in range(5):
        correlation = np.cov(samples[:, row].T) / np.outer(scale[row], scale[row])
        np.testing.assert_allclose(correlation, covariance[row] / np.outer(scale[row], scale[row]), atol=0.04)


def test_marginals_and_picked_components(full):
    density, covariance = full
    value = torch.linspace(-2, 2, 5, dtype=torch.float64)[:, None]
    for index in range(3):
        wanted = stats.norm(density.mean[:, index].numpy(), np.sqrt(covariance[:, index, index]))
        log_prob = marginal(density, index).log_prob(value).numpy()
        np.testing.assert_allclose(log_prob, wanted.logpdf(value[:, 0].numpy()), rtol=1e-10)
    chosen = pick(density, torch.tensor([3, 0]))
    whole = density.log_prob(value.expand(5, 3)[:, None])
    torch.testing.assert_close(chosen.log_prob(value.expand(5, 3)[:, None]), whole[:, [3, 0]])


@pytest.mark.parametrize("covariance", ["diagonal", "full"])
def test_calibration_maximises_the_likelihood(covariance):
    head = build_head({"scale": "fixed", "covariance": covariance}).double()
    torch.manual_seed(2)
    mixing = torch.tensor([[1.0, 0, 0], [0.8, 0.3, 0], [-2.0, 0.1, 0.5]], dtype=torch.float64)
    raw = torch.randn(400, 3, dtype=torch.float64)
    target = raw + torch.randn(400, 3, dtype=torch.float64) @ mixing.T
    before = head.loss(raw, target)
    head.calibrate(raw, target)
    residual = (target - raw).numpy()
    wanted = residual.T @ residual / 400  # maximum likelihood of a covariance around a known mean
    wanted = wanted if covariance == "full" else np.diag(np.diag(wanted))
    best = stats.multivariate_normal(np.zeros(3), wanted).logpdf(residual)
    np.testing.assert_allclose(head(raw).log_prob(target).numpy(), best, rtol=1e-9)
    assert torch.equal(head.loss(raw, target), before)  # squared error does not change with calibration


def test_calibration_on_perfect_collinear_and_no_data():
    head = build_head({"scale": "fixed", "covariance": "full"})
    raw = torch.randn(20, 3)
    head.calibrate(raw, raw)
    assert torch.allclose(head.scale, torch.full((3,), 1e-4, dtype=torch.float64))
    head.calibrate(raw, raw + torch.randn(20, 1))  # all three numbers have the same error
    assert head(raw).log_prob(raw).isfinite().all()
    with pytest.raises(ValueError, match="this split is empty"):
        head.calibrate(raw[:0], raw[:0])


def test_the_fixed_loss_is_half_the_squared_error_up_to_a_constant():
    head = build_head({"scale": "fixed"}).double()
    raw, target = torch.randn(7, 3).double(), torch.randn(7, 3).double()
    constant = head.loss(raw, target) - (raw - target).square().sum(-1) / 2
    torch.testing.assert_close(constant, constant[0].expand(7))


def test_the_scale_is_smooth_and_bounded():
    raw = torch.tensor([-1e-9, 0.0, 1e-9], dtype=torch.float64, requires_grad=True)
    scale = scale_of_raw(raw)
    (slope,) = torch.autograd.grad(scale.sum(), raw)
    torch.testing.assert_close(scale, torch.ones(3).double(), rtol=0, atol=2e-9)
    torch.testing.assert_close(slope, torch.ones(3).double(), rtol=0, atol=2e-9)
    assert scale_of_raw(torch.tensor(1e30)) == pytest.approx(1e12)


def test_one_number_with_full_covariance_is_the_diagonal_head():
    assert build_head({"covariance": "full"}, ONE).size == build_head({}, ONE).size == 2


def test_reparametrised_samples_have_gradients():
    mean = torch.zeros(1, 2, requires_grad=True)
    Gaussian(mean, torch.ones(1, 2)).rsample((3,)).sum().backward()
    assert torch.equal(mean.grad, torch.full((1, 2), 3.0))


@pytest.mark.parametrize("kind", ["angle", "class"])
def test_other_targets_are_refused(kind):
    with pytest.raises(ConfigError, match="gaussian describes targets of kind 'real'"):
        build_head({}, Target(kind, ("azimuth", "elevation")))


@pytest.mark.parametrize("covariance", ["diagonal", "full"])
def test_balance_changes_the_gradient_by_the_scale_and_not_the_value(covariance):
    target = torch.randn(7, 3, dtype=torch.float64)
    raw = torch.randn(7, build_head({"covariance": covariance}).size, dtype=torch.float64, requires_grad=True)
    gradients, losses = [], []
    for balance in (0.0, 0.5, 1.0):
        head = build_head({"covariance": covariance, "balance": balance}).double()
        losses.append(head.loss(raw, target))
        gradients.append(torch.autograd.grad(losses[-1].sum(), raw)[0])
    scale = build_head({"covariance": covariance}).double()(raw).scale.detach()
    for loss in losses[1:]:
        torch.testing.assert_close(loss, losses[0])
    # the raw parameter of a scale appears in the density of its own number only
    own = slice(3, 6)
    torch.testing.assert_close(gradients[1][:, own], gradients[0][:, own] * scale)
    torch.testing.assert_close(gradients[2][:, own], gradients[0][:, own] * scale.square())
    if covariance == "diagonal":  # with β = 1, means learn as with squared error (Seitzer et al. 2022)
        torch.testing.assert_close(gradients[2][:, :3], raw[:, :3].detach() - target)


def test_balance_without_predicted_scales_is_refused():
    with pytest.raises(ConfigError, match=r"balance is 0\.5, but it has no effect with scale=fixed"):
        build_head({"scale": "fixed", "balance": 0.5})


@pytest.mark.parametrize("config", [{"floor": 0.0}, {"scale": "guess"}, {"covariance": "low_rank"}])
def test_a_config_out_of_range_is_refused(config):
    with pytest.raises(ConfigError, match=r"density_head\."):
        build_head(config)


@pytest.mark.parametrize("numbers", [2, 3, 20, 100])
def test_a_covariance_is_a_number_or_refused(numbers):
    """Check raw parameters of any size: infinite or NaN deviations, samples or marginals always raise an error."""
    target = Target("real", tuple(f"x{i}" for i in range(numbers)))
    head = build(
        "density_head", resolve("density_head", {"name": "gaussian", "covariance": "full"}), target=target
    )
    for dtype in (torch.float32, torch.float64):
        for size in (0.1, 1.0, 30.0, 1e3):
            density = head.to(dtype)(torch.full((1, head.size), size, dtype=dtype))
            assert (
                density.log_prob(torch.zeros(1, numbers, dtype=dtype)).isfinite()
                and density.entropy().isfinite()
            )
            # the largest deviation: σ (1 + φ)^(n - 1) for equal coefficients
            log_largest = math.log10(density.scale.max()) + (numbers - 1) * math.log10(
                1 + density.coefficients.max()
            )
            if log_largest < math.log10(torch.finfo(dtype).max) - 1:
                assert density.stddev.isfinite().all() and density.rsample().isfinite().all()
                assert marginal(density, numbers - 1).scale.log10().item() == pytest.approx(
                    log_largest, abs=1
                )
            else:
                for ask in (lambda d: d.stddev, lambda d: d.rsample(), lambda d: marginal(d, numbers - 1)):
                    with pytest.raises(ValueError, match="covariance=diagonal"):
                        ask(density)


def test_mixed_precision_does_not_round_the_covariance():
    """Compare densities and samples under autocast with those in float32."""
    torch.manual_seed(0)
    head = build_head({"covariance": "full"})
    raw = torch.randn(50, head.size)
    value = 5 * torch.randn(50, 3)

    def compute_results():
        torch.manual_seed(1)
        density = head(raw)
        return [density.log_prob(value), density.sample(), *quadratic_bound(density, value)]

    wanted = compute_results()
    with torch.autocast("cpu", torch.bfloat16):
        in_half_precision = compute_results()
    for rounded, exact in zip(in_half_precision, wanted, strict=True):
        torch.testing.assert_close(rounded, exact, rtol=1e-5, atol=1e-5)
