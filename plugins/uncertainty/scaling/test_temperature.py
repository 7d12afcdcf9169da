import functools
import logging
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy import optimize, special, stats
from torch import nn
from torch.distributions import Categorical, Independent, Normal

from framework.configuration.schema import build, resolve
from framework.distributions.density import Mixture
from framework.distributions.tempering import temper
from framework.errors import ConfigError, UserError
from framework.model import Predictor
from framework.target import Target
from framework.testing.metrics import Cardioid
from framework.testing.plain import Plain

CLASSES, ANGLE, REAL = Target("class", ("a", "b", "c")), Target("angle", ("azimuth",)), Target("real", ("x",))


class PredictorOf(Predictor):
    """A predictor whose density is a given function of the inputs."""

    def __init__(self, make):
        super().__init__()
        self.make = make
        self.weight = nn.Parameter(torch.ones(()))
        self.calibrated = 0

    def forward(self, inputs):
        assert not self.training, "densities were asked for in training mode"
        return self.make(inputs * self.weight)

    def loss(self, inputs, target):
        return -self.make(inputs * self.weight).log_prob(target)

    def training_densities(self, inputs):
        return self.make(inputs * self.weight)

    def calibrate(self, batches):
        for _ in batches:
            self.calibrated += 1


def classes(inputs):
    return Categorical(logits=inputs.log_softmax(-1), validate_args=False)


def reals(inputs):
    return Independent(
        Normal(inputs[..., :1], inputs[..., 1:].exp(), validate_args=False), 1, validate_args=False
    )


def around(model, target=CLASSES, **config):
    resolved = resolve("uncertainty", {"name": "temperature", **config})
    return build("uncertainty", resolved, model=lambda: model, target=target)


def once(inputs, target, size=50):
    """Return batches that can be read only once."""
    index = torch.arange(len(target))
    parts = zip(inputs.split(size), target.split(size), index.split(size), strict=True)
    return ({"input": a, "target": b, "index": c} for a, b, c in parts)


def labelled(count, scale, seed=0, dtype=torch.float64):
    """Return logits, and labels drawn from logits / scale: the best temperature is about `scale`."""
    generator = torch.Generator().manual_seed(seed)
    logits = scale * 2 * torch.randn(count, 3, generator=generator, dtype=dtype)
    label = torch.multinomial(torch.softmax(logits.double() / scale, -1), 1, generator=generator)[:, 0]
    return logits, label


def cross_entropy(logits, label, logarithm):
    """Return the mean negative log-likelihood at log T, by SciPy."""
    return -special.log_softmax(logits / math.exp(logarithm), -1)[np.arange(len(label)), label].mean()


@pytest.mark.parametrize("prior", [None, 1.0, 0.03])
@pytest.mark.parametrize("scale", [0.2, 1.0, 6.0])
def test_the_temperature_agrees_with_scipy(scale, prior):
    for dtype, digits in ((torch.float64, 1e-7), (torch.float32, 2e-3)):
        logits, label = labelled(400, scale, dtype=dtype)
        wrapper = around(PredictorOf(classes), prior=prior).eval()
        wrapper.calibrate(once(logits, label))
        likelihood = functools.partial(cross_entropy, logits.double().numpy(), label.numpy())

        count = len(label)

        def nll(logarithm, likelihood=likelihood, count=count):
            penalty = 0 if prior is None else -stats.norm.logpdf(logarithm, scale=prior) / count
            return likelihood(logarithm) + penalty

        wanted = optimize.minimize_scalar(
            nll, bounds=(math.log(0.05), math.log(20)), method="bounded", options={"xatol": 1e-12}
        )
        assert nll(wrapper.temperature.log().item()) <= wanted.fun + digits**2
        assert wrapper.temperature.item() == pytest.approx(math.exp(wanted.x), rel=digits)


@pytest.mark.parametrize("spread, wanted", [(0.5, 0.25), (3.0, 9.0)])
def test_of_normals_it_is_the_ratio_of_variances(spread, wanted):
    """Compare with T = mean of squared standardised residuals, in closed form."""
    generator = torch.Generator().manual_seed(1)
    inputs = torch.randn(2000, 2, generator=generator, dtype=torch.float64)
    noise = spread * torch.randn(2000, 1, generator=generator, dtype=torch.float64)
    target = inputs[:, :1] + inputs[:, 1:].exp() * noise
    wrapper = around(PredictorOf(reals), REAL).eval()
    wrapper.calibrate(once(inputs, target, 64))
    exact = ((target - inputs[:, :1]) / inputs[:, 1:].exp()).square().mean().item()
    assert wrapper.temperature.item() == pytest.approx(exact, rel=1e-6)
    assert exact == pytest.approx(wanted, rel=0.1)


@pytest.mark.slow
def test_of_any_angle_and_of_a_mixture():
    """Check that a cardioid of power 3 equals a cardioid at T = 1/3, also as members of a mixture."""
    generator = torch.Generator().manual_seed(2)
    normal = torch.randn(3, 800, generator=generator, dtype=torch.float64)
    place = normal[0, :, None]
    # with t = tan(θ/2), density ∝ 1/(1+t²)^4: √7 t is Student's with 7 degrees of freedom
    chi = torch.randn(7, 800, generator=generator, dtype=torch.float64).norm(dim=0)
    target = place + 2 * torch.atan(normal[1] / chi)[:, None]
    alone = around(PredictorOf(Cardioid), ANGLE).eval()
    alone.calibrate(once(place, target, 400))
    assert alone.temperature.item() == pytest.approx(1 / 3, rel=0.25)

    def twice(inputs):
        places = inputs.unsqueeze(1).expand(-1, 2, -1)
        return Mixture(torch.zeros(places.shape[:2], dtype=inputs.dtype), Cardioid(places))

    members = around(PredictorOf(twice), ANGLE).eval()
    members.calibrate(once(place, target, 400))
    assert members.temperature.item() == pytest.approx(alone.temperature.item(), rel=1e-6)


def test_never_worse_than_before_even_with_several_maxima():
    """Check mixtures whose likelihood has two maxima in the temperature."""
    generator = torch.Generator().manual_seed(3)
    for trial in range(12):
        inputs = torch.randn(30, 2, generator=generator)
        target = inputs[:, :1] + 10 ** (2 * torch.rand((), generator=generator)) * torch.randn(
            30, 1, generator=generator
        )

        def mixture(inputs, gap=1.0 + trial):
            places = torch.stack([inputs[:, :1], inputs[:, :1] + gap, inputs[:, :1] - 3 * gap], 1)
            base = Normal(places, torch.full_like(places, 0.05), validate_args=False)
            weights = torch.tensor([0.0, -2.0, -6.0]).expand(len(inputs), 3)
            return Mixture(weights, Independent(base, 1, validate_args=False))

        wrapper = around(PredictorOf(mixture), REAL).eval()
        before = wrapper(inputs).log_prob(target).double().mean()
        wrapper.calibrate(once(inputs, target))
        after = wrapper(inputs).log_prob(target).double().mean()
        assert after >= before - 1e-6 * (1 + before.abs())
        grid = torch.logspace(math.log10(0.05), math.log10(20), 200, dtype=torch.float64)
        best = max(
            temper(mixture(inputs), temperature).log_prob(target).double().mean().item()
            for temperature in grid
        )
        assert after >= best - 1e-5 * (1 + abs(best))


def test_a_separable_set_stops_at_the_bound_and_says_so(caplog):
    logits = torch.tensor([[3.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 9.0]])
    for inputs, label in (
        (logits, torch.arange(3)),
        (logits[:1].expand(5, 3), torch.zeros(5, dtype=torch.int64)),
    ):
        caplog.clear()
        wrapper = around(PredictorOf(classes), lower=0.1).eval()
        wrapper.calibrate(once(inputs, label))
        assert wrapper.temperature.item() == pytest.approx(0.1)
        assert "stopped at its lower bound 0.1" in caplog.text and "perfectly separable" in caplog.text
        assert wrapper(inputs).log_prob(label).isfinite().all()
    caplog.clear()
    wrapper = around(PredictorOf(classes)).eval()
    wrapper.calibrate(once(1e4 * logits, (torch.arange(3) + 1) % 3))  # sure, and always wrong
    assert wrapper.temperature.item() == pytest.approx(20) and "upper bound 20" in caplog.text


@pytest.mark.parametrize("count", [3, 30, 300])
def test_with_a_prior_a_model_that_is_right_about_few_samples_stays_near_one(caplog, count):
    """Compare with the bound from the prior: (log T)² / 2 is at most the negative log-likelihood at T = 1."""
    logits = torch.tensor([[5.0, 0.0, 0.0], [0.0, 6.0, 0.0], [0.0, 0.0, 9.0]], dtype=torch.float64)
    label = torch.arange(count) % 3
    wrapper = around(PredictorOf(classes), prior=1.0).eval()
    lost = -torch.distributions.Categorical(logits=logits[label]).log_prob(label).sum().item()
    wrapper.calibrate(once(logits[label], label))
    assert math.exp(-math.sqrt(2 * lost)) < wrapper.temperature < 1
    assert not caplog.text


def test_uniform_densities_leave_it_at_one_and_it_is_said(caplog):
    for inputs in (torch.zeros(40, 3), torch.full((40, 3), -1e4)):
        caplog.clear()
        wrapper = around(PredictorOf(classes)).eval()
        wrapper.calibrate(once(inputs, torch.arange(40) % 3))
        assert wrapper.temperature.item() == 1
        assert "the same at any" in caplog.text
        assert wrapper(inputs).log_prob(torch.zeros(40, dtype=torch.int64)).exp()[0].item() == pytest.approx(
            1 / 3
        )


def test_probabilities_of_exactly_zero_and_one(caplog):
    logits, label = labelled(200, 2.0)
    logits[:3], label[:3] = torch.tensor([0.0, -math.inf, -math.inf]), torch.tensor([0, 1, 2])
    wrapper = around(PredictorOf(classes)).eval()
    wrapper.calibrate(once(logits, label))
    assert "2 of 200 validation targets have probability 0" in caplog.text
    partly_impossible = around(PredictorOf(classes)).eval()
    keep = torch.ones(200, dtype=torch.bool)
    keep[1:3] = False
    partly_impossible.calibrate(once(logits[keep], label[keep]))
    assert wrapper.temperature.item() == pytest.approx(partly_impossible.temperature.item(), rel=1e-6)
    impossible = around(PredictorOf(classes)).eval()
    impossible.calibrate(once(logits[:1].expand(4, 3), torch.ones(4, dtype=torch.int64)))
    assert impossible.temperature.item() == 1


def test_nan_is_named_and_an_empty_set_refused():
    logits, label = labelled(120, 1.0)
    logits[[3, 70]] = math.nan
    with pytest.raises(UserError, match=r"log-likelihood of validation samples \[3, 70\] is NaN"):
        around(PredictorOf(classes)).calibrate(once(logits, label))
    for nothing in (iter(()), once(logits[:0], label[:0])):
        with pytest.raises(
            UserError, match="temperature is calibrated on the validation split, but this split is empty"
        ):
            around(PredictorOf(classes)).calibrate(nothing)


def test_what_is_wrapped_is_calibrated_first_and_left_as_it_was():
    logits, label = labelled(120, 3.0)
    model = PredictorOf(classes)
    wrapper = around(model).train()
    model.zero_grad()
    wrapper.calibrate(once(logits, label))
    assert model.calibrated == 3 and wrapper.training and model.training
    assert model.weight.grad is None
    wrapper.eval()
    twice = around(
        around(PredictorOf(classes))
    ).eval()  # a temperature of a temperature has nothing left to do
    twice.calibrate(once(logits, label))
    assert twice.model.temperature.item() == pytest.approx(wrapper.temperature.item())
    assert twice.temperature.item() == pytest.approx(1, abs=1e-6)


def test_training_does_not_see_it():
    model = Plain(CLASSES)
    wrapper = around(model)
    wrapper.temperature.fill_(5.0)
    inputs, label = torch.randn(4, 6), torch.tensor([0, 1, 2, 0])
    model.dropout.p = 0.0
    assert torch.equal(wrapper.loss(inputs, label), model.loss(inputs, label))
    assert torch.equal(wrapper.training_densities(inputs).logits, model(inputs).logits)
    assert wrapper.knobs == {} and set(wrapper.state_dict()) >= {"temperature"}


@settings(max_examples=40, deadline=None)
@given(
    arrays.arrays(np.float64, (12, 3), elements=st.floats(-1e4, 1e4)),
    arrays.arrays(np.int64, 12, elements=st.integers(0, 2)),
    st.floats(0.01, 1),
    st.floats(1, 100),
)
def test_never_outside_its_bounds_and_never_worse(logits, label, lower, upper):
    inputs, target = torch.from_numpy(logits), torch.from_numpy(label)
    wrapper = around(PredictorOf(classes), lower=lower, upper=upper).eval()
    before = wrapper(inputs).log_prob(target).mean()
    wrapper.calibrate(once(inputs, target))
    assert lower <= wrapper.temperature <= upper
    after = wrapper(inputs).log_prob(target).mean()
    assert after.isfinite() and after >= before - 1e-12 * before.abs()


@pytest.mark.parametrize(
    "config", [{"lower": 0.0}, {"lower": 2.0}, {"upper": 0.5}, {"upper": math.inf}, {"prior": 0.0}]
)
def test_a_config_out_of_range_is_refused(config):
    with pytest.raises(ConfigError, match="uncertainty"):
        around(PredictorOf(classes), **config)


def test_the_log_is_quiet_on_ordinary_sets(caplog):
    caplog.set_level(logging.WARNING)
    around(PredictorOf(classes)).calibrate(once(*labelled(300, 2.0)))
    assert not caplog.text
