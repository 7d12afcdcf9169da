import statistics

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special
from scipy.stats import chi2, norm, sem
from sklearn.metrics import log_loss
from torch.distributions import Categorical, Distribution, Independent, Normal

from framework.configuration.schema import build, resolve
from framework.distributions.protocol import Estimate, estimate, exact_estimate
from framework.errors import UserError
from framework.prediction import Prediction
from plugins.metric.log_likelihood.metric import LogLikelihood, compute_moments, merge_moments, unlikely_gap


class KnownLikelihood(Distribution):
    """Density with given log-likelihoods."""

    arg_constraints = {}  # noqa: RUF012 - as torch has it

    def __init__(self, log_prob):
        self.values = log_prob
        super().__init__(log_prob.shape, torch.Size((1,)), validate_args=False)

    def log_prob(self, value):
        return self.values


estimate.register(KnownLikelihood, exact_estimate)


class UndeclaredLikelihood(KnownLikelihood):
    """Density with given log-likelihoods that does not declare whether log_prob draws samples."""


estimate.register(UndeclaredLikelihood, estimate.dispatch(Distribution))


class SampledLikelihood(KnownLikelihood):
    """Density whose log-likelihoods are estimates, with standard errors 0.1, 0.2, ... from 10, 20, ... samples."""


@estimate.register
def _(density: SampledLikelihood, value):
    number = torch.arange(1, len(density.values) + 1)
    error = 0.1 * number.double()
    return Estimate(density.values, density.values + error.square() / 2, error, 10 * number, number == 2)


def prediction(values, dtype=torch.float64):
    log_prob = torch.as_tensor(values, dtype=dtype)
    return Prediction(KnownLikelihood(log_prob), {"target": torch.zeros(len(log_prob), 1)})


def compute_metric(*batches, dtype=torch.float64):
    metric = LogLikelihood()
    for batch in batches:
        metric.update(prediction(batch, dtype))
    return {name: value.item() for name, value in metric.compute().items()}


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-6), (torch.float64, 1e-14)])
def test_mean_and_standard_error_equal_scipys(dtype, tolerance):
    generator = np.random.default_rng(0)
    target, loc, scale = generator.normal(size=(3, 200, 1))
    scale = np.exp(scale)
    expected = norm(loc, scale).logpdf(target)[:, 0]
    density = Independent(Normal(torch.tensor(loc, dtype=dtype), torch.tensor(scale, dtype=dtype)), 1)
    metric = build("metric", resolve("metric", "log_likelihood"))
    metric.update(Prediction(density, {"target": torch.tensor(target, dtype=dtype)}))
    actual = metric.compute()
    assert actual["log_likelihood"].dtype == torch.float64
    assert actual["log_likelihood"].item() == pytest.approx(expected.mean(), rel=tolerance)
    assert actual["log_likelihood_sem"].item() == pytest.approx(sem(expected), rel=tolerance * 10)


@settings(deadline=None, max_examples=60)
@given(
    st.lists(
        st.lists(st.floats(-1e6, 1e3, allow_subnormal=False), max_size=5), min_size=1, max_size=6
    ).filter(lambda batches: sum(map(len, batches)) > 1)
)
def test_results_do_not_depend_on_the_batches(batches):
    values = [value for batch in batches for value in batch]
    actual = compute_metric(*batches)
    assert actual["log_likelihood"] == pytest.approx(statistics.fmean(values), rel=1e-12, abs=1e-9)
    error = (
        statistics.stdev(values) / len(values) ** 0.5
    )  # the module statistics computes with exact fractions
    assert actual["log_likelihood_sem"] == pytest.approx(error, rel=1e-9, abs=1e-9)


def test_a_large_mean_does_not_hide_a_small_spread():
    values = [-1e9 + offset for offset in (0.0, 0.25, 0.5, 0.75)] * 25
    error = statistics.stdev(values) / 10
    assert compute_metric(values[:3], values[3:50], values[50:])["log_likelihood_sem"] == pytest.approx(
        error, rel=1e-6
    )


def test_no_samples_give_nan_and_one_sample_has_no_standard_error():
    assert all(np.isnan(value) for value in compute_metric([]).values())
    single_sample = compute_metric([], [-2.5], [])
    assert single_sample["log_likelihood"] == -2.5
    assert np.isnan(single_sample["log_likelihood_sem"])


def test_an_impossible_target_makes_the_mean_minus_infinity():
    assert compute_metric([-1.0, -np.inf], [-2.0], [-np.inf])["log_likelihood"] == -np.inf
    assert np.isnan(compute_metric([-1.0], [np.nan], [-2.0])["log_likelihood"])


def split_and_whole():
    generator = torch.Generator().manual_seed(1)
    values = torch.randn(37, generator=generator, dtype=torch.float64) * 3 - 1e5
    first, second, whole = LogLikelihood(), LogLikelihood(), LogLikelihood()
    first.update(prediction(values[:11]))
    second.update(prediction(values[11:]))
    whole.update(prediction(values))
    return first, second, whole.compute()


def test_two_processes_give_the_results_of_all_samples():
    first, second, whole = split_and_whole()
    idle = LogLikelihood()  # a process without samples

    def gather(state, group=None):
        name = "moments" if len(state) == 3 else "sampling"
        return [state, getattr(second, name), getattr(idle, name)]

    first.dist_sync_fn, first.distributed_available_fn = gather, lambda: True
    for name, value in first.compute().items():
        torch.testing.assert_close(value, whole[name], rtol=1e-12, atol=0)


def test_moments_of_parts_in_any_order():
    parts = torch.stack([compute_moments(torch.randn(size, dtype=torch.float64)) for size in (3, 0, 1, 20)])
    torch.testing.assert_close(merge_moments(parts), merge_moments(parts.flip(0)))


def predict_sampled(values):
    log_prob = torch.tensor(values, dtype=torch.float64)
    return Prediction(SampledLikelihood(log_prob), {"target": torch.zeros(len(values), 1)})


def test_exact_densities_report_no_sampling_error():
    assert set(compute_metric([1.0, 2.0])) == {"log_likelihood", "log_likelihood_sem"}


def test_undeclared_densities_report_a_nan_sampling_error():
    metric, negative = LogLikelihood(), build("metric", resolve("metric", "nll"))
    for values in ([1.0, 2.0], [6.0]):
        log_prob = torch.tensor(values, dtype=torch.float64)
        for either_metric in (metric, negative):
            either_metric.update(
                Prediction(UndeclaredLikelihood(log_prob), {"target": torch.zeros(len(log_prob), 1)})
            )
    actual = metric.compute()
    assert actual["log_likelihood"] == 3 and negative.compute()["nll"] == -3
    assert set(actual) == {"log_likelihood", "log_likelihood_sem", "log_likelihood_mc_error"}
    assert actual["log_likelihood_mc_error"].isnan() and negative.compute()["nll_mc_error"].isnan()


def test_estimates_report_their_error_and_their_samples():
    metric = LogLikelihood()
    for values in ([1.0, 2.0, 6.0], [], [3.0]):
        metric.update(predict_sampled(values))
    actual = {name: value.item() for name, value in metric.compute().items()}
    assert actual["log_likelihood"] == 3.0
    squares = [0.01, 0.04, 0.09, 0.01]
    assert actual["log_likelihood_debiased"] == pytest.approx(3 + sum(squares) / 8)
    assert actual["log_likelihood_mc_error"] == pytest.approx(sum(squares) ** 0.5 / 4)
    assert actual["samples_mean"] == pytest.approx((10 + 20 + 30 + 10) / 4)
    assert actual["samples_max"] == 30
    assert actual["items_above_tolerance"] == 1


def test_merged_estimates_equal_those_of_all_samples():
    first, second, whole = LogLikelihood(), LogLikelihood(), LogLikelihood()
    first.update(predict_sampled([1.0, -1e3]))
    second.update(predict_sampled([2.0, -3.0, 5.0]))
    for values in ([1.0, -1e3], [2.0, -3.0, 5.0]):
        whole.update(predict_sampled(values))
    first.merge_state(second)
    for name, value in first.compute().items():
        torch.testing.assert_close(value, whole.compute()[name], rtol=1e-12, atol=0)


def negative(*batches):
    metric = build("metric", resolve("metric", "nll"))
    for batch in batches:
        metric.update(batch)
    return {name: value.item() for name, value in metric.compute().items()}


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-6), (torch.float64, 1e-13)])
@pytest.mark.parametrize("classes", [2, 7])
def test_nll_of_classes_equals_sklearns_log_loss(dtype, tolerance, classes):
    generator = np.random.default_rng(0)
    logits = torch.tensor(3 * generator.normal(size=(90, classes)), dtype=dtype)
    label = generator.integers(classes, size=90)
    actual = negative(Prediction(Categorical(logits=logits), {"target": torch.tensor(label)}))
    probability = special.softmax(logits.double().numpy(), -1)
    probability /= probability.sum(-1, keepdims=True)
    assert actual["nll"] == pytest.approx(log_loss(label, probability, labels=range(classes)), rel=tolerance)
    assert actual["nll_sem"] == pytest.approx(sem(-np.log(probability[np.arange(90), label])), rel=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nll_of_logits_of_ten_thousand(dtype):
    logits = torch.tensor([[1e4, -1e4], [-1e4, 1e4]], dtype=dtype)
    actual = negative(Prediction(Categorical(logits=logits), {"target": torch.tensor([0, 0])}))
    assert actual == {"nll": 1e4, "nll_sem": 1e4}


def test_nll_is_the_negative_of_the_log_likelihood_with_the_same_error():
    values = [1.0, -2.0, 6.5, -1e3]
    actual, positive = (
        negative(prediction(values[:3]), prediction([]), prediction(values[3:])),
        compute_metric(values),
    )
    assert actual["nll"] == -positive["log_likelihood"]
    assert actual["nll_sem"] == pytest.approx(positive["log_likelihood_sem"], rel=1e-14)


def test_nll_of_certain_predictions_is_zero_and_of_impossible_targets_infinite():
    assert str(negative(prediction([0.0, 0.0]))["nll"]) == "0.0"
    assert negative(prediction([-1.0, -np.inf]))["nll"] == np.inf
    assert all(np.isnan(value) for value in negative(prediction([])).values())


def test_nan_log_likelihoods_raise_a_clear_message():
    with pytest.raises(
        UserError, match=r"2 of 3 log-likelihoods of the targets in this batch are NaN.* row 0"
    ):
        negative(prediction([np.nan, 1.0, np.nan]))


def test_nll_of_estimates_has_the_opposite_bias():
    actual = negative(predict_sampled([1.0, 2.0, 6.0]), predict_sampled([]), predict_sampled([3.0]))
    squares = [0.01, 0.04, 0.09, 0.01]
    assert actual["nll"] == -3.0
    assert actual["nll_debiased"] == pytest.approx(-3 - sum(squares) / 8)
    assert actual["nll_mc_error"] == pytest.approx(sum(squares) ** 0.5 / 4)
    assert (actual["samples_max"], actual["items_above_tolerance"]) == (30, 1)


def test_targets_far_below_the_median_are_reported():
    metric = LogLikelihood()
    metric.update(prediction([-1.0, -20.5, 0.0]))
    assert not metric.remarks()
    metric.update(prediction([-1.0, -21.5, 0.0]))
    (remark,) = metric.remarks()
    assert "1 of 6 targets are more than 20 nats less likely" in remark
    assert "test sample 1, target 0, with -21.5 nats" in remark
    metric.reset()
    assert not metric.remarks()


@pytest.mark.parametrize("numbers", [1, 2, 10, 100, 1000])
def test_targets_of_calibrated_densities_are_as_rarely_reported_for_many_numbers(numbers):
    gap = unlikely_gap(numbers)
    least = chi2.median(numbers) / 2 + gap
    assert chi2.logsf(2 * least, numbers) == pytest.approx(chi2.logsf(40 + chi2.median(1), 1), rel=1e-9)
    assert gap >= 20 - 1e-9
    metric = LogLikelihood()
    for distance in (0.99, 1.01):
        density = KnownLikelihood(torch.tensor([0.0, -distance * gap, 0.0]))
        metric.update(Prediction(density, {"target": torch.zeros(3, numbers)}))
    (remark,) = metric.remarks()
    assert f"1 of 6 targets are more than {gap:.3g} nats less likely" in remark


def test_a_target_of_many_numbers_is_shortened():
    metric = LogLikelihood()
    density = KnownLikelihood(torch.tensor([-1.0, -210.5, 0.0]))
    metric.update(Prediction(density, {"target": torch.arange(300.0).reshape(3, 100)}))
    (remark,) = metric.remarks()
    assert len(remark) < 500 and "target 100, 101, 102" in remark
