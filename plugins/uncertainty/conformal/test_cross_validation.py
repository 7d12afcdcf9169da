"""Tests of CV+ intervals against MAPIE and a brute-force form of their definition, and of their coverage."""

import math

import numpy as np
import pytest
import torch
from mapie.regression import CrossConformalRegressor
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import PredefinedSplit

from framework.configuration.schema import build, resolve
from framework.distributions.exported import exported
from framework.distributions.protocol import marginal, value_set
from framework.errors import CheckpointError, ConfigError, UserError
from framework.model import Predictor
from framework.target import Target
from framework.uncertainty import SelfTraining
from plugins.uncertainty.conformal import wrapper as conformal_module
from plugins.uncertainty.conformal.cross_validation import IntervalSet, cross_validation_interval

REAL = Target("real", ("x",))


class LeastSquares(Predictor, SelfTraining):
    """Linear least squares, once without each part of the samples; the density is a Gaussian around the prediction."""

    def __init__(self, parts):
        super().__init__()
        self.part_count = parts
        self.register_buffer("weights", torch.zeros(parts, 4, dtype=torch.float64))
        self.part = None
        self.head = build("density_head", resolve("density_head", "gaussian"), target=REAL)

    def train_models(self, inputs, target, *, seed=0, batch_size=1, most_steps=None):
        generator = torch.Generator().manual_seed(seed)
        self.part = (
            torch.arange(len(inputs))[torch.randperm(len(inputs), generator=generator)] % self.part_count
        )
        for part in range(self.part_count):
            kept = self.part != part
            self.weights[part] = torch.linalg.lstsq(inputs[kept], target[kept]).solution.squeeze(-1)
        return 0.0

    def part_of(self, rows):
        return self.part[rows]

    def forward(self, inputs):
        every = inputs @ self.weights.T
        if self.left_out is not None:
            centre = every[:, self.left_out]
        elif self.rows is not None:
            centre = every[torch.arange(len(inputs)), self.part_of(self.rows)]
        else:
            centre = every.mean(1)
        return self.head(torch.stack([centre, torch.zeros_like(centre)], -1))

    training_densities = forward

    def loss(self, inputs, target):
        return -self(inputs).log_prob(target)

    def calibrate(self, batches):
        pass


def table(count, seed, noise=0.5):
    generator = torch.Generator().manual_seed(seed)
    inputs = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    target = inputs.sum(1) + inputs[:, 0].square() + noise * torch.randn(count, generator=generator).double()
    return inputs, target.unsqueeze(-1)


def conformal(model, **config):
    part = resolve("uncertainty", {"name": "conformal", "score": "cv_plus", **config})
    return build("uncertainty", part, model=lambda: model, target=REAL).eval()


def trained(count=40, parts=5, seed=0, **config):
    inputs, target = table(count, seed)
    model = LeastSquares(parts)
    model.train_models(inputs, target, seed=seed)
    wrapper = conformal(model, **config)
    rows = torch.arange(count)
    wrapper.calibrate(
        [{"input": inputs[some], "target": target[some], "row": some} for some in rows.split(16)]
    )
    return wrapper, inputs, target


@pytest.mark.parametrize("parts, miscoverage", [(2, 0.2), (5, 0.1), (40, 0.1), (5, 0.024)])
def test_intervals_equal_the_definition(parts, miscoverage):
    """Compare with the definition of Barber et al. 2021, one input and one sample at a time."""
    wrapper, inputs, target = trained(parts=parts, miscoverage=miscoverage)
    model, new = wrapper.model, table(7, 99)[0]
    intervals = value_set(wrapper(new))
    x, y, count = inputs.numpy(), target.numpy()[:, 0], len(inputs)
    for item, point in enumerate(new.numpy()):
        lows, highs = [], []
        for sample in range(count):
            kept = (model.part != model.part[sample]).numpy()
            weights = np.linalg.lstsq(x[kept], y[kept], rcond=None)[0]
            residual = abs(y[sample] - x[sample] @ weights)
            lows.append(point @ weights - residual)
            highs.append(point @ weights + residual)
        first, last = (
            math.floor(round(miscoverage * (count + 1), 9)),
            math.ceil(round((1 - miscoverage) * (count + 1), 9)),
        )
        low = sorted(lows)[first - 1] if first >= 1 else -math.inf
        high = sorted(highs)[last - 1] if last <= count else math.inf
        np.testing.assert_allclose(
            [intervals.low[item].item(), intervals.high[item].item()], [low, high], rtol=1e-9
        )


@pytest.mark.parametrize(
    "parts, count, miscoverage", [(5, 40, 0.1), (4, 41, 0.2), (39, 39, 0.1), (5, 40, 0.024)]
)
def test_intervals_equal_those_of_mapie(parts, count, miscoverage):
    wrapper, inputs, target = trained(count, parts, miscoverage=miscoverage)
    other = CrossConformalRegressor(
        LinearRegression(fit_intercept=False),
        confidence_level=1 - miscoverage,
        cv=PredefinedSplit(wrapper.model.part.numpy()),
    )
    other.fit_conformalize(inputs.numpy(), target.numpy()[:, 0])
    new = table(200, 99)[0]
    _, ends = other.predict_interval(new.numpy(), allow_infinite_bounds=True)
    intervals = value_set(wrapper(new))
    np.testing.assert_allclose(np.stack([intervals.low, intervals.high], 1), ends[..., 0], rtol=1e-9)


@pytest.mark.parametrize("parts, count", [(5, 50), (39, 39)], ids=["CV+", "jackknife+"])
def test_coverage_over_200_draws_of_a_table(parts, count):
    """Check that the mean coverage is at least 1 - α within its error, and not far above.

    The upper bound leaves room for the models' smaller training parts, whose residuals are a little larger.
    """
    shares = []
    for draw in range(200):
        wrapper = trained(count, parts, seed=draw, miscoverage=0.1)[0]
        inputs, target = table(100, 10_000 + draw)
        shares.append(value_set(wrapper(inputs)).contains(target).double().mean().item())
    error = np.std(shares, ddof=1) / math.sqrt(len(shares))
    assert 0.9 - 3 * error < np.mean(shares) < 0.93 + 3 * error


def test_many_residuals_in_pieces_give_the_same_ends(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    centres = torch.randn(50, 4, generator=generator)
    residuals, parts = torch.rand(300, generator=generator).double(), torch.arange(300) % 4
    whole = cross_validation_interval(centres, residuals, parts, 0.1)
    monkeypatch.setattr("plugins.uncertainty.conformal.cross_validation.ENTRIES", 1000)
    for one, other in zip(whole, cross_validation_interval(centres, residuals, parts, 0.1), strict=True):
        assert torch.equal(one, other)


def test_the_set_has_length_parts_and_an_unchanged_density():
    wrapper, _, _ = trained()
    new = table(3, 5)[0]
    density = wrapper(new)
    assert isinstance(density, IntervalSet) and density.stated_probability == 0.9
    torch.testing.assert_close(density.size(), density.high - density.low)
    assert density.parts() == [
        [pair] for pair in zip(density.low.tolist(), density.high.tolist(), strict=True)
    ]
    assert not density.empty().any()
    value = density.low.unsqueeze(-1)
    assert density.contains(torch.stack([value, value - 1e-6])).tolist() == [[True] * 3, [False] * 3]
    assert torch.equal(density.log_prob(value), wrapper.model(new).log_prob(value))
    assert marginal(density, 0) is density
    crossed = IntervalSet(wrapper.model(new), density.high, density.low, 0.9)
    assert crossed.empty().all() and crossed.parts() == [[], [], []] and crossed.size().sum() == 0
    with pytest.raises(ConfigError, match="score=cv_plus cannot be exported"):
        exported(density)


def test_a_stored_state_gives_the_same_intervals_and_a_damaged_one_is_refused():
    wrapper, inputs, _ = trained()
    other = conformal(LeastSquares(5))
    assert value_set(other(inputs)).size().isinf().all()  # before calibration every set holds all values
    other.load_state_dict(wrapper.state_dict())
    assert torch.equal(value_set(other(inputs)).low, value_set(wrapper(inputs)).low)
    state = wrapper.state_dict()
    state["parts"] = state["parts"] + 5
    with pytest.raises((CheckpointError, ValueError, RuntimeError), match="parts"):
        other.load_state_dict(state)


def test_folds_are_the_models_around_which_it_works():
    inputs, target = table(60, 3)
    from framework.model import Model

    def model():
        encoder = build("encoder", resolve("encoder", {"name": "mlp", "widths": [8]}), input_shape=(4,))
        return Model([encoder], build("density_head", resolve("density_head", "gaussian"), target=REAL))

    torch.manual_seed(0)
    folds = build(
        "uncertainty",
        resolve("uncertainty", {"name": "folds", "folds": 3, "steps": 40, "epochs": 1}),
        model=model,
        target=REAL,
    )
    inputs, target = inputs.float(), target.float()
    folds.train_models(inputs, target, seed=0, batch_size=16)
    wrapper = conformal(folds)
    wrapper.calibrate([{"input": inputs, "target": target, "row": torch.arange(60)}])
    assert "CV+ intervals from the residuals of 60 samples. They hold at least 61.7 %" in wrapper.remark
    sets = value_set(wrapper(inputs))
    assert 0.85 <= sets.contains(target).double().mean() <= 1
    folds.left_out = 1
    with torch.no_grad():
        by_left_out = folds(inputs).log_prob(target)
        folds.left_out = None
        folds.rows = (folds.part_of(torch.arange(60)) == 1).nonzero().flatten()[:1].expand(60)
        assert torch.equal(by_left_out, folds(inputs).log_prob(target))
        folds.rows = None


def test_samples_that_trained_no_model_give_no_interval_and_a_remark(caplog):
    wrapper, inputs, target = trained()
    wrapper.calibrate([{"input": inputs, "target": target}])
    assert "needs the samples on which the models were trained" in wrapper.remark
    assert wrapper.remark in caplog.messages
    assert value_set(wrapper(inputs)).size().isinf().all()


def test_what_is_refused(monkeypatch):
    with pytest.raises(
        ConfigError, match=r"no wrapper inside conformal trains such models. Write uncertainty=\[folds"
    ):
        conformal(type("Plain", (LeastSquares,), {})(0))
    part = resolve("uncertainty", {"name": "conformal", "score": "cv_plus"})
    for target, message in (
        (Target("angle", ("pan",)), "describes targets of kind 'real'"),
        (Target("real", ("x", "y")), "intervals of one real number, but the target is x, y"),
    ):
        with pytest.raises(ConfigError, match=message):
            build("uncertainty", part, model=lambda: LeastSquares(5), target=target)
    wrapper, inputs, target = trained()
    bad = target.clone()
    bad[3] = math.nan
    with pytest.raises(UserError, match=r"The residual of validation samples \[3\] is NaN"):
        wrapper.calibrate([{"input": inputs, "target": bad, "row": torch.arange(40)}])
    monkeypatch.setattr(conformal_module, "MOST_RESIDUALS", 30)
    with pytest.raises(ConfigError, match="at most 30 samples, but there are 40"):
        wrapper.calibrate([{"input": inputs, "target": target, "row": torch.arange(40)}])
