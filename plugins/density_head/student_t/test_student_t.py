import math

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.integrate import quad

from framework.configuration.schema import build, resolve
from framework.distributions.batch_shapes import Stacked
from framework.distributions.density import Mixture
from framework.distributions.intervals import central_interval
from framework.distributions.protocol import cdf, median, ranked_score, tempered_density
from framework.errors import ConfigError, UserError
from framework.target import Target
from plugins.density_head.student_t.density import NORMAL, StudentT
from plugins.density_head.student_t.functions import digamma_step, log_gamma_step
from plugins.density_head.student_t.rows import ONE, TWO

FREEDOMS = (2.1, 3.0, 7.5, 49.0, 51.0, 1e4, NORMAL)


def build_head(target=ONE, **config):
    return build("density_head", resolve("density_head", {"name": "student_t", **config}), target=target)


def density_of(freedom, count=5, dtype=torch.float64):
    location = torch.linspace(-3, 1e3, count, dtype=dtype)[:, None]
    scale = torch.logspace(-4, 4, count, dtype=dtype)[:, None]
    return StudentT(location, scale, torch.tensor([freedom], dtype=dtype))


@pytest.mark.parametrize("freedom", FREEDOMS)
def test_every_function_agrees_with_scipy(freedom):
    density = density_of(freedom)
    expected = stats.t(freedom, density.location.numpy(), density.scale.numpy())
    value = density.location + density.scale * torch.tensor([-1e3, -2.0, 0.0, 0.3, 9.0]).double()[:, None]
    np.testing.assert_allclose(density.cdf(value), expected.cdf(value), rtol=1e-9)
    probability = torch.tensor([1e-12, 0.05, 0.5, 0.9, 1 - 1e-6]).double()[:, None]
    quantile = density.icdf(probability)
    far = ((quantile - density.location) / density.scale).numpy()
    np.testing.assert_allclose(far, stats.t.ppf(probability, freedom), rtol=1e-7)
    np.testing.assert_allclose(density.entropy(), expected.entropy()[:, 0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(density.variance, expected.var(), rtol=1e-9)
    ends = central_interval(density, 0.9)
    np.testing.assert_allclose(ends.low, expected.ppf(0.05), rtol=1e-9)
    np.testing.assert_allclose(ends.high, expected.ppf(0.95), rtol=1e-9)


@pytest.mark.parametrize("freedom", FREEDOMS)
@pytest.mark.parametrize("away", [0.0, 0.7, -30.0])
def test_the_score_is_the_integral_of_the_squared_difference(freedom, away):
    density = StudentT(
        torch.zeros(1, 1).double(), torch.full((1, 1), 2.0).double(), torch.tensor([freedom]).double()
    )
    expected = stats.t(freedom, 0, 2)
    below = quad(lambda x: expected.cdf(x) ** 2, -math.inf, away, limit=400)[0]
    above = quad(lambda x: expected.sf(x) ** 2, away, math.inf, limit=400)[0]
    score = ranked_score(density, torch.full((1, 1), away).double())
    assert score.item() == pytest.approx(below + above, rel=1e-6)


def test_the_steps_of_gamma_are_continuous_where_the_series_begins():
    x = torch.tensor([25 - 1e-12, 25.0, 25 + 1e-12], dtype=torch.float64)
    for function in (log_gamma_step, digamma_step):
        below, middle, above = function(x).tolist()
        assert below == pytest.approx(middle, abs=1e-13) and above == pytest.approx(middle, abs=1e-13)


def test_targets_that_a_gaussian_excludes_cost_a_few_nats():
    density = density_of(5.0, dtype=torch.float32)
    far = density.log_prob(density.location + 1e25 * density.scale)
    assert far.isfinite().all() and (far - density.log_prob(density.location) > -400).all()


def test_powers_without_a_variance_are_refused():
    with pytest.raises(UserError, match="has a variance only at temperatures below 2"):
        tempered_density(density_of(5.0), torch.tensor(3.0))


@pytest.mark.parametrize("freedom", [3.0, 5.0, NORMAL])
def test_calibration_finds_scale_and_degrees_of_freedom(freedom):
    head = build_head(Target("real", ("x", "y"), location=(5.0, -3.0), scale=(0.1, 40.0))).double()
    torch.manual_seed(0)
    raw = torch.randn(20_000, 4, dtype=torch.float64)
    predicted = head(raw)
    density = StudentT(predicted.location, predicted.scale * math.exp(-0.5), torch.tensor(freedom))
    target = density.sample()
    before = head.loss(raw, target)
    head.calibrate(raw, target)
    assert head.factor.log().tolist() == pytest.approx([-0.5, -0.5], abs=0.051)
    assert ((head.freedom == freedom) | (freedom > 1e7) & (head.freedom >= 30)).all()
    assert torch.equal(head.loss(raw, target), before)


def test_few_samples_keep_the_density_near_the_predicted_one():
    head = build_head().double()
    head.calibrate(torch.zeros(1, 2).double(), torch.full((1, 1), 2.0).double())
    assert 1 <= head.factor.item() < 1.6
    head.calibrate(torch.zeros(1, 2).double(), torch.zeros(1, 1).double())
    assert head.factor.item() > 0.7 and head.freedom.item() == NORMAL
    with pytest.raises(ValueError, match="this split is empty"):
        head.calibrate(torch.zeros(0, 2).double(), torch.zeros(0, 1).double())


def test_balance_changes_the_gradient_by_the_scale_and_not_the_value():
    raw = torch.randn(7, 4, dtype=torch.float64, requires_grad=True)
    target = torch.randn(7, 2, dtype=torch.float64)
    gradients, losses = [], []
    for balance in (0.0, 0.5):
        head = build_head(TWO, balance=balance).double()
        losses.append(head.loss(raw, target))
        gradients.append(torch.autograd.grad(losses[-1].sum(), raw)[0])
    scale = build_head(TWO).double()(raw).scale.detach()
    torch.testing.assert_close(losses[1], losses[0])
    torch.testing.assert_close(gradients[1], gradients[0] * scale.repeat(1, 2))


@pytest.mark.parametrize(
    "config", [{"degrees_of_freedom": 2.0}, {"degrees_of_freedom": "guess"}, {"balance": 2}]
)
def test_a_config_out_of_range_is_refused(config):
    with pytest.raises(ConfigError, match=r"density_head\."):
        build_head(**config)


@pytest.mark.parametrize("freedom", [3.0, 4.0, 7.5, 30.0, 40.0, 41.0])
def test_many_distribution_functions_keep_the_digits_of_both_tails(freedom):
    value = torch.linspace(-200, 200, 2001, dtype=torch.float64)[:, None]
    density = StudentT(
        torch.zeros(2001, 1).double(), torch.ones(2001, 1).double(), torch.tensor([freedom]).double()
    )
    np.testing.assert_allclose(density.cdf(value), stats.t(freedom).cdf(value), rtol=1e-9)


def test_the_median_of_a_mixture_is_exact():
    torch.manual_seed(0)
    location, scale = 3 * torch.randn(50, 4, 1).double(), torch.rand(50, 4, 1).double() + 0.01
    mixture = Mixture(torch.randn(50, 4).double(), StudentT(location, scale, torch.tensor([5.0]).double()))
    nested = Mixture(torch.zeros(50, 2).double(), Stacked([mixture, mixture]))
    # densities so narrow that there is almost nothing between them
    far = StudentT(100 * location, 0.01 * scale, torch.tensor([30.0]).double())
    for density in (mixture, nested, Mixture(torch.randn(50, 4).double(), far)):
        value = median(density, 10)
        assert torch.equal(median(density, 10), value)
        torch.testing.assert_close(cdf(density, value), torch.full((50,), 0.5).double(), rtol=0, atol=1e-9)
