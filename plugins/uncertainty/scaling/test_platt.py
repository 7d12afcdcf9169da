import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy import optimize, special
from sklearn.calibration import CalibratedClassifierCV
from sklearn.frozen import FrozenEstimator
from sklearn.linear_model import LogisticRegression
from torch.distributions import Categorical

from framework.configuration.schema import build, resolve
from framework.distributions.density import Mixture
from framework.errors import ConfigError, UserError
from framework.model import Predictor
from framework.target import Target
from plugins.uncertainty.scaling.platt import LARGEST_BIAS, STEEPEST, fit, targets

TWO, THREE = Target("class", ("off", "on")), Target("class", ("a", "b", "c"))


class PredictorOf(Predictor):
    """A predictor whose density is a given function of the inputs."""

    def __init__(self, make):
        super().__init__()
        self.make = make

    def forward(self, inputs):
        return self.make(inputs)

    def loss(self, inputs, target):
        return -self(inputs).log_prob(target)

    def training_densities(self, inputs):
        return self(inputs)

    def calibrate(self, batches):
        pass


def classes(inputs):
    return Categorical(logits=inputs.log_softmax(-1), validate_args=False)


def around(make=classes, target=THREE, **config):
    resolved = resolve("uncertainty", {"name": "platt", **config})
    return build("uncertainty", resolved, model=lambda: PredictorOf(make), target=target).eval()


def batches(inputs, target, size=64):
    index = torch.arange(len(target))
    parts = zip(inputs.split(size), target.split(size), index.split(size), strict=True)
    return ({"input": a, "target": b, "index": c} for a, b, c in parts)


def labelled(count, classes, seed=0, slope=2.5):
    generator = torch.Generator().manual_seed(seed)
    logits = slope * torch.randn(count, classes, generator=generator, dtype=torch.float64)
    shift = torch.linspace(-1, 1, classes, dtype=torch.float64)
    label = torch.multinomial(torch.softmax(logits / slope + shift, -1), 1, generator=generator)[:, 0]
    return logits, label


@pytest.mark.parametrize("seed", range(3))
def test_two_classes_agree_with_scikit_learn(seed):
    """Compare with scikit-learn, which fits 1/(1 + exp(A f + B)) with Platt's targets, quasi-Newton (eq. 2.18)."""
    logits, label = labelled(300, 2, seed)
    odds = (logits[:, 1] - logits[:, 0]).numpy()[:, None]
    wrapper = around(target=TWO)
    wrapper.calibrate(batches(logits, label))
    model = LogisticRegression().fit(odds, label)
    model.coef_, model.intercept_ = np.ones((1, 1)), np.zeros(1)  # its decision is the log-odds
    other = CalibratedClassifierCV(FrozenEstimator(model), method="sigmoid").fit(odds, label.numpy())
    probability = wrapper(logits).log_prob(torch.ones(300, dtype=torch.int64)).exp()
    np.testing.assert_allclose(probability.numpy(), other.predict_proba(odds)[:, 1], atol=2e-4)


@pytest.mark.parametrize("count", [2, 3, 6])
@pytest.mark.parametrize("smoothing", [True, False])
def test_several_classes_agree_with_scipy(count, smoothing):
    logits, label = labelled(200, count)
    log_prob = logits.log_softmax(-1)
    slope, biases = fit(log_prob, label, smoothing=smoothing)
    wanted = targets(label, count, smoothing=smoothing).numpy()

    def cross_entropy(x):
        return -(wanted * special.log_softmax(x[0] * log_prob.numpy() + x[1:], -1)).sum(-1).mean()

    best = optimize.minimize(
        cross_entropy, np.r_[1.0, np.zeros(count)], method="BFGS", options={"gtol": 1e-8}
    )
    assert cross_entropy(np.r_[slope, biases.numpy()]) <= best.fun + 1e-12
    assert slope == pytest.approx(best.x[0], rel=1e-4)
    np.testing.assert_allclose(biases.numpy(), best.x[1:] - best.x[1:].mean(), atol=1e-4)
    assert biases.sum().item() == pytest.approx(0, abs=1e-12)


def test_smoothed_targets_are_platts():
    label = torch.tensor([1, 1, 1, 0])
    smoothed = targets(label, 2, smoothing=True)
    # (N₊ + 1)/(N₊ + 2) with 3 positive ones, 1/(N₋ + 2) with 1 negative one
    np.testing.assert_allclose(smoothed[:, 1].numpy(), [4 / 5, 4 / 5, 4 / 5, 1 / 3])
    np.testing.assert_allclose(smoothed.sum(-1).numpy(), 1)
    many = targets(torch.tensor([0, 2, 2]), 4, smoothing=True)
    np.testing.assert_allclose(many[1].numpy(), [1 / 6, 1 / 6, 3 / 6, 1 / 6])


def test_labels_as_they_are_make_the_likelihood_no_worse():
    for seed in range(5):
        logits, label = labelled(80, 3, seed)
        wrapper = around(smoothing=False)
        before = wrapper(logits).log_prob(label).mean()
        wrapper.calibrate(batches(logits, label))
        assert wrapper(logits).log_prob(label).mean() >= before


@pytest.mark.parametrize("size", [1.0, 1e4])
def test_separable_and_one_class_sets(size, caplog):
    logits = size * torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]).double().repeat(10, 1)
    label = torch.arange(3).repeat(10)
    smooth = around()
    smooth.calibrate(batches(logits, label))
    assert not caplog.text
    # the smoothed targets themselves, (10 + 1)/(10 + 3), which three equal margins can express
    np.testing.assert_allclose(smooth(logits).log_prob(label).exp().numpy(), 11 / 13, rtol=1e-6)
    plain = around(smoothing=False)
    plain.calibrate(batches(logits, label))
    assert plain.slope.item() <= STEEPEST and plain(logits).log_prob(label).isfinite().all()
    if size == 1.0:
        assert plain.slope.item() == STEEPEST and "slope stopped at its bound 20" in caplog.text
    caplog.clear()
    alike = torch.zeros(30, dtype=torch.int64)
    smooth.calibrate(batches(logits, alike))
    assert smooth.slope.item() < 1e-6 and smooth(logits).log_prob(alike).exp()[0].item() == pytest.approx(
        31 / 33
    )
    plain.calibrate(batches(logits, alike))
    assert plain.biases.abs().max() <= 2 * LARGEST_BIAS
    assert plain(logits).log_prob(alike).exp().min().item() > 0.999
    assert plain(logits).log_prob((alike + 1) % 3).isfinite().all()


def test_labels_that_contradict_stop_the_slope_at_zero(caplog):
    logits, label = labelled(300, 3)
    wrapper = around()
    wrapper.calibrate(batches(-5 * logits, label))
    assert wrapper.slope.item() == 0 and "the slope stopped at 0" in caplog.text
    shares = torch.bincount(label, minlength=3) / 300
    np.testing.assert_allclose(wrapper(logits).probs[0].numpy(), shares, atol=0.02)


def test_equal_logits_leave_the_slope(caplog):
    label = torch.arange(40) % 2
    wrapper = around(target=TWO)
    wrapper.calibrate(batches(torch.zeros(40, 2), label))
    np.testing.assert_allclose(wrapper(torch.zeros(4, 2)).probs.numpy(), 0.5, rtol=1e-6)
    assert wrapper.slope.isfinite() and 0 <= wrapper.slope <= STEEPEST


def test_probabilities_of_exactly_zero_and_one():
    logits, label = labelled(200, 3)
    logits[:4] = torch.tensor([0.0, -math.inf, -math.inf])
    label[:4] = torch.tensor([0, 0, 1, 2])
    for smoothing in (True, False):
        wrapper = around(smoothing=smoothing)
        wrapper.calibrate(batches(logits, label))
        assert 0 <= wrapper.slope <= STEEPEST and wrapper.biases.isfinite().all()
        assert wrapper(logits).log_prob(label).isfinite().all()


def test_a_mixture_is_scaled_as_a_whole():
    logits, label = labelled(100, 3)

    def members(inputs):
        both = torch.stack([inputs, inputs.roll(1, -1)], 1)
        return Mixture(torch.tensor([[1.0, -1.0]]).expand(len(inputs), 2), classes(both))

    wrapper = around(members)
    wrapper.calibrate(batches(logits, label))
    assert wrapper.slope != 1
    inner = members(logits).log_prob(torch.arange(3)[:, None].expand(3, 100)).T.numpy()
    wanted = special.log_softmax(wrapper.slope.item() * inner + wrapper.biases.numpy(), -1)
    np.testing.assert_allclose(wrapper(logits).logits.numpy(), wanted, atol=1e-6)
    assert wrapper(logits.float()).logits.dtype == torch.float32


def test_bad_sets_and_targets_get_a_sentence():
    logits, label = labelled(100, 3)
    logits[[2, 80], 1] = math.nan
    with pytest.raises(UserError, match=r"class probabilities of validation samples \[2, 80\] is NaN"):
        around().calibrate(batches(logits, label))
    with pytest.raises(
        UserError, match="platt is calibrated on the validation split, but this split is empty"
    ):
        around().calibrate(iter(()))
    with pytest.raises(ConfigError, match="uncertainty platt describes targets of kind 'class'"):
        around(target=Target("angle", ("azimuth",)))


@settings(max_examples=60, deadline=None)
@given(
    arrays.arrays(np.float64, (12, 3), elements=st.floats(-1e4, 1e4)),
    arrays.arrays(np.int64, 12, elements=st.integers(0, 2)),
    st.booleans(),
)
def test_slope_and_biases_stay_within_their_bounds(logits, label, smoothing):
    log_prob = torch.from_numpy(logits).log_softmax(-1)
    slope, biases = fit(log_prob, torch.from_numpy(label), smoothing=smoothing)
    assert 0 <= slope <= STEEPEST
    assert biases.abs().max() <= 2 * LARGEST_BIAS and biases.sum().abs() < 1e-9
    rescaled = (slope * log_prob + biases).log_softmax(-1)
    assert rescaled.isfinite().all()
