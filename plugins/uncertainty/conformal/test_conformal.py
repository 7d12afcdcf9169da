import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mapie.regression import ConformalizedQuantileRegressor
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.datasets import make_moons
from torch import nn
from torch.distributions import Categorical, Independent, Normal

from framework.configuration.schema import build, resolve
from framework.distributions.batch_shapes import Stacked
from framework.distributions.density import Mixture
from framework.errors import ConfigError, UserError
from framework.model import Model, Predictor
from framework.target import Target
from framework.testing.metrics import Cardioid
from plugins.uncertainty.conformal.prediction_set import PredictionSet
from plugins.uncertainty.conformal.wrapper import split_in_halves, threshold

CLASSES, ANGLE = Target("class", ("upper", "lower")), Target("angle", ("azimuth",))
SPLITS, POOL = 200, 1600


class PredictorOf(Predictor):
    """A predictor with the density `make(inputs)`, which records the rows on which it is calibrated."""

    def __init__(self, make):
        super().__init__()
        self.make = make
        self.calibration_rows = []
        self.weight = nn.Parameter(torch.ones(()))

    def forward(self, inputs):
        return self.make(inputs)

    def loss(self, inputs, target):
        return -self(inputs).log_prob(target) * self.weight

    def training_densities(self, inputs):
        return self(inputs)

    def calibrate(self, batches):
        self.calibration_rows = torch.cat([batch["index"] for batch in batches]).tolist()


def around(model, target=CLASSES, name="conformal", **config):
    resolved = resolve("uncertainty", {"name": name, **config})
    return build("uncertainty", resolved, model=lambda: model, target=target).eval()


def batches(inputs, target, size=100):
    index = torch.arange(len(target))
    parts = zip(inputs.split(size), target.split(size), index.split(size), strict=True)
    return ({"input": a, "target": b, "index": c} for a, b, c in parts)


def moons(count):
    """Return two moons, and logits of a fixed, strongly overconfident classifier."""
    points, label = make_moons(count, noise=0.35, random_state=0)
    return torch.from_numpy(points), torch.from_numpy(label)


def sure_classifier(points):
    x, y = points.unbind(-1)
    margin = 6 * (0.25 + 0.6 * torch.sin(2.2 * x + 0.4) - y)
    return Categorical(logits=torch.stack([-margin, margin], -1).log_softmax(-1), validate_args=False)


def circle(count):
    """Return von Mises noise around directions, with κ that varies with the input."""
    generator = np.random.default_rng(0)
    inputs = generator.uniform(-3, 3, (count, 2))
    noise = generator.vonmises(0, 4 + 3 * np.tanh(inputs[:, 1]))
    return torch.from_numpy(inputs), torch.from_numpy(inputs[:, :1] + noise[:, None])


def sure_direction(inputs):
    """Return densities with the correct direction, and a κ that is eight times too large."""
    kind = type(build("density_head", resolve("density_head", "von_mises"), target=ANGLE)(torch.zeros(1, 3)))
    return kind(inputs[:, :1], 8 * (4 + 3 * torch.tanh(inputs[:, 1:])))


PROBLEMS = {"moons": (moons, sure_classifier, CLASSES), "circle": (circle, sure_direction, ANGLE)}


@pytest.mark.parametrize("problem", PROBLEMS)
@pytest.mark.parametrize("score", ["density", "mass"])
@pytest.mark.parametrize("miscoverage", [0.1, 0.05])
def test_coverage_is_as_stated(problem, score, miscoverage):
    """Check the mean coverage over 200 random splits of one pool to 1 %, for badly calibrated models.

    Half of the validation samples of every split are left to the wrapped model, as the wrapper does.
    """
    make, predict, target = PROBLEMS[problem]
    inputs, label = make(POOL)
    wrapper = around(PredictorOf(predict), target, score=score, miscoverage=miscoverage)
    scores = wrapper(inputs).scores(label)
    half = POOL // 2
    mine = torch.cat(
        [batch["index"] for batch in split_in_halves(list(batches(inputs[:half], label[:half])))[1]]
    )
    generator = torch.Generator().manual_seed(0)
    covered = []
    for _ in range(SPLITS):
        order = torch.randperm(POOL, generator=generator)
        validation, test = scores[order[:half]], scores[order[half:]]
        covered.append((test <= threshold(validation[mine], miscoverage)).double().mean())
    assert torch.stack(covered).mean().item() == pytest.approx(1 - miscoverage, abs=0.01)
    # the wrapper does the same on one of them, and its sets hold what its scores say
    wrapper.calibrate(batches(inputs[order[:half]], label[order[:half]]))
    assert wrapper.threshold.item() == pytest.approx(threshold(validation[mine], miscoverage), rel=1e-9)
    rest = order[half:]
    inside = wrapper(inputs[rest]).contains(label[rest])
    assert inside.double().mean().item() == pytest.approx(covered[-1].item(), abs=2 / len(rest))
    # without it, the model's own region of that mass covers too little
    if score == "mass":
        own = PredictionSet(predict(inputs), -torch.tensor(miscoverage).double().log(), "mass")
        assert own.contains(label).double().mean().item() < 1 - miscoverage - 0.03


@pytest.mark.slow
def test_around_a_temperature_it_still_covers():
    inputs, label = moons(1500)
    generator = torch.Generator().manual_seed(1)
    covered = []
    for _ in range(20):
        order = torch.randperm(1500, generator=generator)
        first, rest = order[:1000], order[1000:]
        inner = around(PredictorOf(sure_classifier), name="temperature")
        wrapper = around(inner, miscoverage=0.1, score="mass")
        wrapper.calibrate(batches(inputs[first], label[first]))
        covered.append(wrapper(inputs[rest]).contains(label[rest]).double().mean())
    # one split's coverage has a standard deviation of about 0.019, so their mean one of 0.004
    assert torch.stack(covered).mean().item() == pytest.approx(0.9, abs=0.02)
    assert inner.temperature.item() > 1.5
    alone = around(PredictorOf(sure_classifier), name="temperature")
    theirs, _ = split_in_halves(list(batches(inputs[first], label[first])))
    alone.calibrate(theirs)
    assert inner.temperature.item() == alone.temperature.item()


@pytest.mark.parametrize("target", [CLASSES, ANGLE])
def test_wrappers_compose_in_any_order(target):
    def members(inputs):
        both = [inputs[:, :2], 0.5 * inputs[:, :2]]
        if target is CLASSES:
            parts = [Categorical(logits=parameters, validate_args=False) for parameters in both]
        else:
            parts = [Cardioid(parameters[:, :1]) for parameters in both]
        return Mixture(torch.zeros(len(inputs), 2, dtype=inputs.dtype), Stacked(parts))

    torch.manual_seed(0)
    inputs = torch.randn(80, 2, dtype=torch.float64)
    label = members(inputs).sample()
    names = ["temperature", "conformal"] + (["platt"] if target is CLASSES else [])
    for first in names:
        for second in names:
            wrapper = around(around(PredictorOf(members), target, name=first), target, name=second)
            wrapper.calibrate(batches(inputs, label, 16))
            density = wrapper(inputs)
            assert isinstance(density, PredictionSet) == (second == "conformal")
            assert density.log_prob(label).isfinite().all() and density.log_prob(label).shape == (80,)


@pytest.mark.parametrize("score", ["density", "mass", "quantiles"])
@pytest.mark.parametrize("kind", ["class", "real"])
@pytest.mark.parametrize("offset", [1.0, 1e4])
def test_rounding_takes_no_equal_inputs_out_of_their_sets(score, kind, offset):
    """Compare the sets of repeated inputs with sets of densities that differ by float32 rounding.

    Four different inputs and whole-number targets give many equal scores, many of them equal to the threshold.
    """
    if score == "quantiles" and kind == "class":
        return
    target = CLASSES if kind == "class" else Target("real", ("count",))
    random = torch.Generator().manual_seed(0)
    for trial in range(20):
        logits = offset**0.25 * torch.randn(4, 2, generator=random)
        rounding = torch.zeros(())

        def make(inputs, logits=logits):
            chosen = logits[inputs[:, 0].long()] * (1 + rounding)  # noqa: B023
            if kind == "class":
                return Categorical(logits=chosen.log_softmax(-1), validate_args=False)
            location = offset * chosen[:, :1].double().round() + 1e-6 * offset * rounding.double()  # noqa: B023
            return Independent(Normal(location, offset * torch.ones_like(location)), 1, validate_args=False)

        inputs = torch.randint(4, (400, 1), generator=random).float()
        torch.manual_seed(trial)
        label = make(inputs).sample()
        label = label if kind == "class" else offset * (label / offset).round()
        wrapper = around(PredictorOf(make), target, score=score, miscoverage=0.2)
        wrapper.calibrate(batches(inputs, label))
        inside = wrapper(inputs).contains(label)
        for relative in (-2e-7, -1e-7, 1e-7, 2e-7):
            rounding = torch.tensor(relative)
            assert torch.equal(wrapper(inputs).contains(label), inside), (trial, relative)


def test_what_is_wrapped_gets_one_half():
    model = PredictorOf(sure_classifier)
    inputs, label = moons(47)
    wrapper = around(model)
    wrapper.calibrate(batches(inputs, label, 5))
    theirs = set(model.calibration_rows)
    rest = torch.tensor([index for index in range(47) if index not in theirs])
    assert len(theirs) == 24 and model.calibration_rows == sorted(theirs)
    mine = PredictionSet(sure_classifier(inputs[rest]), wrapper.threshold, "density").scores(label[rest])
    assert wrapper.threshold.item() == threshold(mine, 0.1)
    wrapper.calibrate(batches(inputs, label, 11))  # the batches do not matter
    assert set(model.calibration_rows) == theirs
    ones = split_in_halves(list(batches(inputs[:4], label[:4], 1)))
    assert [len(half) for half in ones] == [2, 2]  # no empty batches


def test_neighbours_that_alternate_do_not_split_by_class():
    inputs, label = moons(400)
    turns = torch.stack([(label == 0).nonzero()[:190, 0], (label == 1).nonzero()[:190, 0]], 1).flatten()
    inner = around(PredictorOf(sure_classifier), name="platt")
    around(inner).calibrate(batches(inputs[turns], label[turns]))
    assert inner.slope > 0.05 and inner.biases.abs().max() < 1


@settings(deadline=None)
@given(st.lists(st.floats(allow_nan=False), min_size=1, max_size=200), st.integers(1, 99))
def test_the_threshold_is_the_order_statistic(scores, percent):
    """Compare with the ⌈(n + 1)(1 - α)⌉-th smallest score, in exact integers."""
    rank = -(-(len(scores) + 1) * (100 - percent) // 100)
    wanted = sorted(scores)[rank - 1] if rank <= len(scores) else math.inf
    assert threshold(torch.tensor(scores, dtype=torch.float64), percent / 100) == wanted


@pytest.mark.parametrize("count", [1, 2, 9, 1000])
def test_however_much_may_be_missed_the_threshold_is_the_least_score(count):
    scores = torch.arange(count, dtype=torch.float64)
    for near in (1e-9, 1e-12, 1e-13, 1e-15, 2**-53):
        assert threshold(scores, 1 - near) == 0


@pytest.mark.parametrize("score", ["density", "mass"])
def test_too_few_samples_make_the_set_everything_and_it_is_said(score, caplog):
    inputs, label = moons(16)  # 8 samples for the threshold; 10 % needs 9
    wrapper = around(PredictorOf(sure_classifier), score=score)
    assert wrapper(inputs).labels().all()  # before calibration too
    wrapper.calibrate(batches(inputs, label))
    assert wrapper.threshold.item() == math.inf and wrapper(inputs).labels().all()
    assert "8 validation samples are too few" in caplog.text and "9 samples are enough" in caplog.text
    caplog.clear()
    inputs, label = moons(18)
    wrapper.calibrate(batches(inputs, label))
    assert math.isfinite(wrapper.threshold.item()) and not caplog.text


def test_targets_that_are_ruled_out_are_ordinary_scores(caplog):
    def certain(inputs):
        return Categorical(logits=torch.tensor([0.0, -math.inf]).expand(len(inputs), 2), validate_args=False)

    inputs, label = torch.zeros(400, 2), torch.zeros(400, dtype=torch.int64)
    label[::10] = 1  # about 10 %, beyond α = 5 %
    wrapper = around(PredictorOf(certain), miscoverage=0.05)
    wrapper.calibrate(batches(inputs, label))
    assert wrapper(inputs).labels().all() and "every set holds all values" in caplog.text
    loose = around(PredictorOf(certain), miscoverage=0.2)
    loose.calibrate(batches(inputs, label))
    assert loose(inputs).labels().tolist() == [[True, False]] * 400


def test_bad_sets_get_a_sentence():
    inputs, label = moons(60)
    _, mine = split_in_halves(list(batches(inputs, label)))
    first, second = mine[0]["index"][:2].tolist()
    inputs[[first, second]] = math.nan
    with pytest.raises(UserError, match=rf"score of validation samples \[{first}, {second}\] is NaN"):
        around(PredictorOf(sure_classifier)).calibrate(batches(inputs, label))
    with pytest.raises(
        UserError, match="conformal is calibrated on the validation split, but this split is empty"
    ):
        around(PredictorOf(sure_classifier)).calibrate(iter(()))
    with pytest.raises(UserError, match="at least 2 samples are required, but got one sample"):
        around(PredictorOf(sure_classifier)).calibrate(batches(inputs[:1], label[:1]))


@pytest.mark.parametrize("config", [{"miscoverage": 0.0}, {"miscoverage": 1.0}, {"score": "rank"}])
def test_a_config_out_of_range_is_refused(config):
    with pytest.raises(ConfigError, match="uncertainty"):
        around(PredictorOf(sure_classifier), **config)


def spread_pairs(count, generator):
    """Return inputs, and numbers whose noise grows with the input, float64."""
    inputs = generator.uniform(0, 3, (count, 1))
    return torch.from_numpy(inputs), torch.from_numpy(
        inputs + (0.1 + inputs**2) * generator.normal(size=(count, 1))
    )


def quantile_model():
    torch.manual_seed(0)
    height = Target("real", ("height",))
    head = build("density_head", resolve("density_head", "quantiles"), target=height)
    return Model([], head, (1,)).double()


class Quantile(RegressorMixin, BaseEstimator):
    """One quantile of a model, as an estimator of scikit-learn that is already fitted."""

    is_fitted = True  # MAPIE asks for it

    def __init__(self, model, level):
        self.model, self.level = model, level

    def fit(self, rows, values):
        return self

    def predict(self, rows):
        with torch.no_grad():
            return self.model(torch.from_numpy(rows)).quantiles[:, self.level].numpy()


@pytest.mark.parametrize("miscoverage", [0.1, 0.3])
def test_quantiles_are_conformalised_as_romano_et_al_state(miscoverage):
    """Compare with MAPIE and eq. 5-8 of Romano, Patterson & Candès 2019, for quantiles of the head `quantiles`."""
    height, model = Target("real", ("height",)), quantile_model()
    inputs, target = spread_pairs(301, np.random.default_rng(0))
    wrapper = around(model, height, score="quantiles", miscoverage=miscoverage)
    wrapper.calibrate(batches(inputs, target))
    _, own_half = split_in_halves(list(batches(inputs, target)))
    levels = [
        round(20 * level) - 1 for level in (miscoverage / 2, 1 - miscoverage / 2)
    ]  # of 1/20, ..., 19/20

    def quantiles(rows):
        with torch.no_grad():
            return [model(rows).quantiles[:, level].numpy() for level in levels]

    rows, values = (torch.cat([batch[name] for batch in own_half]) for name in ("input", "target"))
    low, high = quantiles(rows)
    scores = np.sort(np.maximum(low - values[:, 0].numpy(), values[:, 0].numpy() - high))
    moved = scores[math.ceil((len(scores) + 1) * (1 - miscoverage)) - 1]
    assert wrapper.threshold.item() == pytest.approx(moved, rel=1e-9)
    new, value = spread_pairs(40, np.random.default_rng(1))
    with torch.no_grad():
        sets = wrapper(new)
    low, high = quantiles(new)
    expected = np.stack([low - moved, high + moved], 1)
    np.testing.assert_allclose(np.array(sets.intervals())[:, 0], expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(sets.size(), expected[:, 1] - expected[:, 0], rtol=1e-9)
    mapie = ConformalizedQuantileRegressor(
        [Quantile(model, levels[0]), Quantile(model, levels[1]), Quantile(model, 9)],
        confidence_level=1 - miscoverage,
        prefit=True,
    )
    mapie.conformalize(rows.numpy(), values.numpy()[:, 0])
    _, ends = mapie.predict_interval(new.numpy(), symmetric_correction=True)
    np.testing.assert_allclose(ends[..., 0], expected, rtol=1e-9, atol=1e-9)
    inside = (value[:, 0].numpy() >= expected[:, 0]) & (value[:, 0].numpy() <= expected[:, 1])
    assert sets.contains(value).tolist() == inside.tolist() and not sets.empty().any()
    assert not sets.size_error().any()


@pytest.mark.slow
def test_conformalised_quantiles_hold_the_stated_share_over_validation_splits():
    height, model = Target("real", ("height",)), quantile_model()
    generator = np.random.default_rng(2)
    covered = []
    for _ in range(150):
        inputs, target = spread_pairs(200, generator)
        wrapper = around(model, height, score="quantiles", miscoverage=0.2)
        wrapper.calibrate(batches(inputs, target))
        with torch.no_grad():
            new, value = spread_pairs(400, generator)
            covered.append(wrapper(new).contains(value).double().mean().item())
    # 1 - α to 1 - α + 1/(n + 1), n = 100; the error of the mean is that of 150 splits
    error = np.std(covered) / math.sqrt(150)
    assert 0.8 - 3 * error < np.mean(covered) < 0.8 + 1 / 101 + 3 * error


def test_quantiles_of_other_targets_are_refused_and_a_narrowed_interval_may_be_empty():
    for inner, target in ((sure_classifier, CLASSES), (sure_direction, ANGLE)):
        with pytest.raises(ConfigError, match=r"score=quantiles moves the two ends .* of one real number"):
            around(PredictorOf(inner), target, score="quantiles")(torch.zeros(3, 2))
    normal = torch.distributions.Independent(
        torch.distributions.Normal(torch.zeros(2, 1), torch.ones(2, 1)), 1
    )
    narrowed = PredictionSet(normal, torch.tensor(-2.0), "quantiles", 0.9)
    assert narrowed.empty().all() and narrowed.intervals() == [[], []] and not narrowed.size().any()
    assert not narrowed.contains(torch.zeros(2, 1)).any()
    whole = PredictionSet(normal, torch.tensor(math.inf), "quantiles", 0.9)
    assert whole.intervals() == [[(-math.inf, math.inf)]] * 2 and whole.contains(torch.zeros(2, 1)).all()
    with pytest.raises(ConfigError, match="needs the probability of the central interval"):
        PredictionSet(normal, torch.tensor(0.0), "quantiles")
