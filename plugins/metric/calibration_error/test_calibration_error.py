import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.patches import Rectangle
from scipy import special
from scipy.stats import binomtest
from torch.distributions import Categorical

from framework.configuration.schema import build, resolve
from framework.distributions.class_probabilities import class_probabilities
from framework.errors import ConfigError, DataError, UserError
from framework.metric import HasFigure
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.calibration_error.metric import NEAR, CalibrationError, equal_mass, equal_width
from plugins.metric.calibration_error.picture import reliability, wilson

TWO = Target("class", ("off", "on"))


def make_prediction(probability, label, dtype=torch.float64):
    """Return a batch with these class probabilities."""
    logits = torch.as_tensor(np.asarray(probability), dtype=dtype).log()
    return Prediction(Categorical(logits=logits, validate_args=False), {"target": torch.as_tensor(label)})


def with_complement(probability):
    """Return the probabilities of both classes from that of the second class."""
    probability = np.asarray(probability, dtype=float)
    return np.stack([1 - probability, probability], -1)


def compute_metric(*batches, target=TWO, **config):
    metric = build("metric", resolve("metric", {"name": "calibration_error", **config}), target=target)
    for batch in batches:
        metric.update(batch)
    return {name: value.item() for name, value in metric.compute().items()}


def loop_width(confidence, right, bins):
    """Return [(count, mean confidence, accuracy)] for the bins of eq. 2.28.

    The edges are slightly lowered, and the last bin is closed.
    """
    bins_with_samples = []
    for number in range(bins):
        last = number == bins - 1
        inside = [
            (c, r)
            for c, r in zip(confidence, right, strict=True)
            if (number == 0 or number / bins - NEAR / 2 <= c) and (last or c < (number + 1) / bins - NEAR / 2)
        ]
        if inside:
            bins_with_samples.append(
                (len(inside), np.mean([c for c, _ in inside]), np.mean([r for _, r in inside]))
            )
    return bins_with_samples


def loop_mass(confidence, right, bins):
    """Return [(count, mean confidence, accuracy)] for bins of equal mass.

    A group of nearly equal confidences belongs to the bin of its middle rank.
    """
    groups = []
    for pair in sorted(zip(confidence, right, strict=True)):
        if not groups or pair[0] > groups[-1][0][0] + NEAR:
            groups.append([])
        groups[-1].append(pair)
    inside = [[] for _ in range(bins)]
    before = 0
    for pairs in groups:
        middle = before + Fraction(len(pairs), 2)
        inside[math.floor(bins * middle / len(confidence))] += pairs
        before += len(pairs)
    return [(len(p), np.mean([c for c, _ in p]), np.mean([r for _, r in p])) for p in inside if p]


def expected_error(bins):
    total = sum(count for count, *_ in bins)
    return sum(count / total * abs(confidence - accuracy) for count, confidence, accuracy in bins)


def debiased_error(bins):
    several = [row for row in bins if row[0] > 1]
    total = sum(count for count, *_ in several)
    if not several:
        return math.nan
    return sum(n / total * ((c - a) ** 2 - a * (1 - a) / (n - 1)) for n, c, a in several)


def check_results(actual, confidence, right, bins, tolerance):
    width, mass = loop_width(confidence, right, bins), loop_mass(confidence, right, bins)
    assert actual["ece"] == pytest.approx(expected_error(width), abs=tolerance)
    assert actual["ece_equal_mass"] == pytest.approx(expected_error(mass), abs=tolerance)
    assert actual["mce"] == pytest.approx(max(abs(c - a) for _, c, a in width), abs=tolerance)
    squared = debiased_error(mass)
    assert actual["squared_ce_debiased"] == pytest.approx(squared, abs=tolerance, nan_ok=True)
    root = math.nan if math.isnan(squared) else math.sqrt(max(0, actual["squared_ce_debiased"]))
    assert actual["ece_debiased"] == pytest.approx(root, abs=1e-12, nan_ok=True)


@settings(deadline=None, max_examples=150)
@given(st.data(), st.integers(1, 40), st.integers(1, 20))
def test_positive_agrees_with_loops(data, samples, bins):
    # edges of bins, 0 and 1, ties, and any other values
    number = st.integers(0, bins).map(lambda k: k / bins) | st.sampled_from([0.0, 0.5, 1.0]) | st.floats(0, 1)
    probability = np.array(data.draw(st.lists(number, min_size=samples, max_size=samples)))
    label = np.array(data.draw(st.lists(st.integers(0, 1), min_size=samples, max_size=samples)))
    cut = data.draw(st.integers(0, samples))
    batch = [
        make_prediction(with_complement(probability[part]), label[part])
        for part in (slice(cut), slice(cut, None))
    ]
    actual = compute_metric(*batch, bins=bins, probability="positive")
    # log and exp in the density may move a probability off the edge of a bin
    probability_of_second = class_probabilities(make_prediction(with_complement(probability), label).density)[
        :, 1
    ]
    np.testing.assert_allclose(probability_of_second, probability, atol=1e-15)
    check_results(actual, probability_of_second.tolist(), label.tolist(), bins, 1e-12)
    assert actual["ece_positive"] == actual["ece"]
    other = compute_metric(*batch, bins=bins)
    assert other["ece_positive"] == actual["ece"], "eq. 2.28-2.29, whatever else is binned"


@settings(deadline=None, max_examples=100)
@given(st.data(), st.integers(2, 10), st.integers(1, 40), st.sampled_from([torch.float32, torch.float64]))
def test_predicted_agrees_with_loops(data, count, samples, dtype):
    logit = st.sampled_from([0.0, 1.0, -2.0, 1e4, -1e4])
    row = st.lists(logit, min_size=count, max_size=count)
    logits = torch.tensor(data.draw(st.lists(row, min_size=samples, max_size=samples)), dtype=dtype)
    label = data.draw(st.lists(st.integers(0, count - 1), min_size=samples, max_size=samples))
    target = Target("class", tuple(str(k) for k in range(count)))
    density = Categorical(logits=logits.log_softmax(-1), validate_args=False)
    actual = compute_metric(Prediction(density, {"target": torch.tensor(label)}), target=target, bins=7)
    probability = class_probabilities(density).numpy()
    np.testing.assert_allclose(probability, special.softmax(logits.double().numpy(), -1), atol=1e-6)
    right = probability.argmax(-1) == np.array(label)  # NumPy returns the first of equal values
    check_results(actual, probability.max(-1).tolist(), right.tolist(), 7, 1e-12)
    assert ("ece_positive" in actual) == (count == 2)


@pytest.mark.parametrize("bins", [*range(1, 31), 100, 1000])
def test_edges_belong_to_the_bin_above_and_one_to_the_last(bins):
    edges = torch.tensor([k / bins for k in range(bins + 1)], dtype=torch.float64)
    assert equal_width(edges, bins).tolist() == [*range(bins), bins - 1]
    below = edges[1:] - NEAR
    assert equal_width(below, bins).tolist() == list(range(bins))


@pytest.mark.parametrize("bins", [1, 3, 15])
def test_bins_of_equal_mass_differ_by_one_sample_at_most(bins):
    for samples in (bins, 50, 1001):
        order = torch.randperm(samples, generator=torch.Generator().manual_seed(0))
        confidence = torch.linspace(0, 1, samples, dtype=torch.float64)
        index = equal_mass(confidence[order], bins)
        sizes = torch.bincount(index, minlength=bins)
        assert sizes.max() - sizes.min() <= 1
        assert torch.equal(
            index[order.argsort()], index.sort().values
        )  # a higher confidence never belongs to a lower bin


def test_equal_confidences_share_a_bin_in_any_order():
    generator = np.random.default_rng(0)
    probability = generator.choice([0.2, 0.4, 0.4000001, 0.9], 60)
    label = generator.integers(2, size=60)
    wanted = compute_metric(
        make_prediction(with_complement(probability), label), bins=4, probability="positive"
    )
    for seed in range(20):
        order = np.random.default_rng(seed).permutation(60)
        batches = [
            make_prediction(with_complement(probability[part]), label[part])
            for part in np.array_split(order, 7)
        ]
        assert compute_metric(*batches, bins=4, probability="positive") == pytest.approx(wanted, abs=1e-13)


@pytest.mark.parametrize("bins", [1, 7, 10, 15, 100])
@pytest.mark.parametrize("parts", [2, 10, 100, 125])
def test_confidences_stay_in_their_bins_under_device_rounding(parts, bins):
    generator = torch.Generator().manual_seed(parts)
    share = (
        torch.randint(parts + 1, (3000,), generator=generator) / parts
    )  # such as shares of votes of trees, float32
    last_digit = torch.randint(-1, 2, share.shape, generator=generator).float()
    near = torch.nextafter(share, share + last_digit).clamp(0, 1).double()
    assert (near != share.double()).any()
    for choose in (equal_width, equal_mass):
        assert torch.equal(choose(near, bins), choose(share.double(), bins))


def test_a_calibrated_model_has_no_error():
    probability = np.repeat([0.25, 0.5, 0.75], 40)
    label = np.concatenate([np.arange(40) < 10, np.arange(40) < 20, np.arange(40) < 30]).astype(int)
    actual = compute_metric(
        make_prediction(with_complement(probability), label), probability="positive", bins=4
    )
    assert actual["ece"] == pytest.approx(0, abs=1e-15) and actual["mce"] == pytest.approx(0, abs=1e-15)
    assert actual["squared_ce_debiased"] < 0 and actual["ece_debiased"] == 0


def test_the_debiased_error_is_unbiased_over_all_outcomes():
    stated, true = np.array([0.3] * 4 + [0.8] * 4), np.array([0.3] * 4 + [0.6] * 4)
    mean = plain = 0.0
    for outcome in itertools.product([0, 1], repeat=8):
        label = np.array(outcome)
        chance = np.where(label == 1, true, 1 - true).prod()
        actual = compute_metric(
            make_prediction(with_complement(stated), label), bins=2, probability="positive"
        )
        mean += chance * actual["squared_ce_debiased"]
        plain += chance * np.mean(
            [
                (s.mean() - y.mean()) ** 2
                for s, y in zip(stated.reshape(2, 4), label.reshape(2, 4), strict=True)
            ]
        )
    assert mean == pytest.approx(0.5 * 0.2**2, abs=1e-12)
    assert plain > 0.5 * 0.2**2 + 0.05


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_confidence_of_one_belongs_to_the_last_bin(dtype):
    logits = torch.tensor([[1e4, -1e4]] * 4, dtype=dtype)
    batch = Prediction(Categorical(logits=logits), {"target": torch.tensor([0, 0, 0, 1])})
    actual = compute_metric(batch)
    assert actual["ece"] == actual["ece_equal_mass"] == actual["mce"] == 0.25
    assert actual["squared_ce_debiased"] == pytest.approx(0.0625 - 0.75 * 0.25 / 3)
    actual = compute_metric(batch, probability="positive")
    assert actual["ece"] == 0.25


def test_results_for_one_sample_and_for_none():
    single_sample = compute_metric(make_prediction([[0.25, 0.75]], [0]))
    assert (
        single_sample["ece"] == single_sample["ece_equal_mass"] == single_sample["mce"] == pytest.approx(0.75)
    )
    assert math.isnan(single_sample["ece_debiased"]) and math.isnan(single_sample["squared_ce_debiased"])
    assert all(
        math.isnan(value)
        for value in compute_metric(make_prediction(np.zeros((0, 2)), np.zeros(0, int))).values()
    )


def test_unsuitable_targets_and_settings_raise_an_error():
    with pytest.raises(ConfigError, match=r"has 3: a, b, c\. Choose probability=predicted"):
        CalibrationError(Target("class", ("a", "b", "c")), probability="positive")
    with pytest.raises(ConfigError, match="metric calibration_error describes targets of kind 'class'"):
        CalibrationError(Target("angle", ("azimuth",)))
    with pytest.raises(ConfigError, match="bins = 0"):
        resolve("metric", {"name": "calibration_error", "bins": 0})
    with pytest.raises(UserError, match="1 of 1 predicted distributions over classes"):
        compute_metric(make_prediction([[np.nan, 0.5]], [0]))
    with pytest.raises(DataError, match="row 0 is 2"):
        compute_metric(make_prediction([[0.5, 0.5]], [2]))


def bars(axes):
    return [patch for patch in axes.patches if isinstance(patch, Rectangle) and patch.get_height() > 0]


def test_the_figure_shows_the_samples():
    metric = CalibrationError(TWO, bins=10)
    # 30 samples at 0.62, 12 of them right; 10 samples at 0.98, all right
    metric.update(make_prediction([[0.38, 0.62]] * 30 + [[0.98, 0.02]] * 10, [1] * 12 + [0] * 28))
    assert isinstance(metric, HasFigure)
    figure = metric.figure("moons/$nothing$", synthetic=True)
    figure.draw_without_rendering()
    above, below = figure.axes
    assert figure.get_suptitle() == "moons/$nothing$ (synthetic data)"
    shown = [(round(bar.get_x(), 9), bar.get_height()) for bar in bars(above)]
    assert shown == [(0.6, 0.75), (0.9, 0.25)]
    labels = [text.get_text() for text in above.get_legend().get_texts()]
    assert labels == ["mean confidence 0.710", "accuracy 0.550"]
    actual = sorted((round(bar.get_x(), 9), round(bar.get_y(), 9), bar.get_height()) for bar in bars(below))
    # a bar up to the lower of accuracy and confidence, and the gap on top of it
    assert [(x, y) for x, y, _ in actual] == [(0.6, 0.0), (0.6, 0.4), (0.9, 0.0), (0.9, 0.98)]
    assert [height for *_, height in actual] == pytest.approx([0.4, 0.22, 0.98, 0.02])
    assert "ECE 0.170 in 10 bins\n40 samples" in [text.get_text() for text in below.texts]
    assert below.get_xlabel() == "confidence in the predicted class"
    assert (
        above.get_xlim() == below.get_xlim() == (0.5, 1.0)
    )  # the confidence for two classes is at least 0.5


def test_the_figure_of_the_positive_class_names_it():
    metric = CalibrationError(Target("class", ("off", "on_$")), probability="positive")
    metric.update(make_prediction([[0.3, 0.7]], [1]))
    figure = metric.figure("real", synthetic=False)
    figure.draw_without_rendering()
    assert (figure.axes[1].get_xlabel(), figure.axes[1].get_ylabel()) == ("p(on_$)", "share of on_$")
    assert figure.axes[1].get_xlim() == (0.0, 1.0)
    assert figure.get_suptitle() == "real"


def test_the_figure_without_samples_says_so():
    figure = CalibrationError(TWO).figure("empty", synthetic=False)
    figure.draw_without_rendering()
    assert [text.get_text() for text in figure.axes[1].texts] == ["no samples"]
    assert not bars(figure.axes[0])


def test_full_bins_and_bins_without_right_predictions_can_be_drawn():
    count = np.full(15, 3.0)
    for right in (np.zeros(15), count):
        figure = reliability(
            count, count, right, confidence_label="c", accuracy_label="a", title="t", synthetic=False
        )
        figure.draw_without_rendering()
        assert len(bars(figure.axes[0])) == 15


@pytest.mark.parametrize("right, count", [(0, 1), (1, 1), (3, 7), (40, 40), (0, 1000), (123, 4567)])
def test_wilson_intervals_equal_scipys(right, count):
    low, high = wilson(np.array([float(right)]), np.array([float(count)]))
    wanted = binomtest(right, count).proportion_ci(0.95, "wilson")
    assert low[0] == pytest.approx(wanted.low, abs=1e-12)
    assert high[0] == pytest.approx(wanted.high, abs=1e-12)
