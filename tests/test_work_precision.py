"""The work-precision diagram against closed forms, brute force and NumPy."""

import csv
import math
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.distributions import Independent, Normal

from framework.data import Batch
from framework.density_head import DensityHead
from framework.distributions.density import Mixture
from framework.encoder import Encoder
from framework.errors import ConfigError
from framework.evaluation.work_precision import (
    Point,
    Reference,
    estimate,
    front,
    pareto,
    reference_value,
    rows,
    run_times,
    work_precision,
    write,
)
from framework.model import Model

CPU = torch.device("cpu")


class Counting(Encoder):
    """Two numbers in, two out; counts its calls."""

    def __init__(self) -> None:
        super().__init__()
        self.output_shape = (2,)
        self.calls = 0

    def forward(self, inputs: Tensor) -> Tensor:
        self.calls += 1
        return inputs


class Convolved(DensityHead):
    """p(y | x) = E_z N(y; x + z, 1) with z ~ N(0, 1), so exactly N(y; x, √2), by Monte Carlo."""

    knobs: ClassVar[dict[str, tuple[int, ...]]] = {"samples": (1, 10, 100)}

    def __init__(self) -> None:
        super().__init__()
        self.size = 1
        self.samples = 7

    def forward(self, raw: Tensor) -> Mixture:
        centre = raw.unsqueeze(-2) + torch.randn(*raw.shape[:-1], self.samples, 1)
        normal = Independent(Normal(centre, torch.ones_like(centre)), 1)
        return Mixture(torch.zeros(*raw.shape[:-1], self.samples), normal)

    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        return -self(raw).log_prob(target)

    def calibrate(self, raw: Tensor, target: Tensor) -> None:
        pass


@pytest.fixture
def model() -> Model:
    torch.manual_seed(0)
    model = Model([Counting()], Convolved())
    with torch.no_grad():
        model.projection.weight.copy_(torch.tensor([[1.0, 0.0]]))
        model.projection.bias.zero_()
    return model.eval()


@pytest.fixture
def batches() -> list[Batch]:
    generator = torch.Generator().manual_seed(1)
    inputs = torch.randn(60, 2, generator=generator)
    target = inputs[:, :1] + 2**0.5 * torch.randn(60, 1, generator=generator)
    return [{"input": inputs[i : i + 25], "target": target[i : i + 25]} for i in range(0, 60, 25)]


def curve_of(model: Model, batches: list[Batch], **changed):
    options = {"knob": "samples", "values": (1, 10, 100), "reference": 2000, "repeats": 6, "seed": 5}
    return work_precision(model, batches, **(options | changed), timed_calls=1, budget_seconds=1.0)


def exact(batches: list[Batch]) -> float:
    inputs = torch.cat([batch["input"] for batch in batches]).double().numpy()
    target = torch.cat([batch["target"] for batch in batches]).double().numpy()
    residual = target[:, 0] - inputs[:, 0]
    return float(np.mean(-0.25 * residual**2 - 0.5 * np.log(4 * np.pi)))  # log N(residual; 0, variance 2)


def test_the_reference_is_the_exact_log_likelihood_within_its_error(
    model: Model, batches: list[Batch]
) -> None:
    reference = curve_of(model, batches).reference
    assert 0 < reference.standard_error < 0.01
    assert abs(reference.log_likelihood - exact(batches)) < 4 * reference.standard_error
    assert reference.log_likelihoods.shape == (60,)


def test_errors_fall_as_samples_grow_and_start_at_the_exact_bias(model: Model, batches: list[Batch]) -> None:
    one, ten, hundred = curve_of(model, batches, repeats=12).points
    assert one.error > ten.error > hundred.error
    assert one.sample_error > ten.sample_error > hundred.sample_error
    # one sample: E log N(r; z, 1) = -(r² + 1)/2 - log(2π)/2
    residual = torch.cat([batch["target"] - batch["input"][:, :1] for batch in batches]).double()
    expected = float((-(residual**2 + 1) / 2).mean()) - 0.5 * math.log(2 * math.pi)
    assert abs(one.log_likelihood - expected) < 4 * one.log_likelihood_sem
    assert one.bias == pytest.approx(abs(expected - exact(batches)), abs=4 * one.log_likelihood_sem + 0.01)
    assert [point.value for point in (one, ten, hundred)] == [1, 10, 100]


def test_the_same_seed_gives_the_same_errors_and_another_does_not(model: Model, batches: list[Batch]) -> None:
    first, again, other = (curve_of(model, batches, seed=seed) for seed in (1, 1, 2))
    assert [point.error for point in first.points] == [point.error for point in again.points]
    assert first.points[0].error != other.points[0].error


def test_model_knob_mode_and_random_numbers_are_left_alone(model: Model, batches: list[Batch]) -> None:
    model.train()
    before = torch.get_rng_state()
    curve_of(model, batches)
    assert model.head.samples == 7
    assert model.training
    assert torch.equal(torch.get_rng_state(), before)


def test_after_an_error_everything_is_left_alone_too(model: Model, batches: list[Batch]) -> None:
    model.train()
    batches[0]["target"][3] = math.inf
    with pytest.raises(ValueError, match=r"sample 3 is -inf \(1 such\)"):
        curve_of(model, batches)
    assert model.head.samples == 7
    assert model.training


def test_the_encoder_runs_once_for_the_errors_and_each_time_for_the_times(
    model: Model, batches: list[Batch]
) -> None:
    curve_of(model, batches)
    values, turns, calls_a_turn = 3, 1 + 1, 2
    assert model.encoders[0].calls == len(batches) + values * turns * calls_a_turn


def test_batches_may_come_once(model: Model, batches: list[Batch]) -> None:
    def once() -> Iterator[Batch]:
        yield from batches

    assert curve_of(model, once()).samples == 60


def test_no_two_estimates_share_random_numbers(model: Model, batches: list[Batch]) -> None:
    """At equal knob values the estimates would be equal if they did."""
    found = curve_of(model, batches, values=(10, 10), reference=10, repeats=2)
    numbers = [point.log_likelihood for point in found.points]
    assert len({*numbers, found.reference.log_likelihood}) == 3


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"knob": "sample"}, "no knob 'sample'. Did you mean 'samples'"),
        ({"reference": 99}, "below the largest value tried, 100"),
        ({"repeats": 1}, "two at least"),
        ({"values": ()}, r"those of Convolved worth trying: \(1, 10, 100\)"),
    ],
)
def test_wrong_wishes_get_a_sentence(model: Model, batches: list[Batch], changed: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        curve_of(model, batches, **changed)


def test_no_batches_get_a_sentence(model: Model) -> None:
    with pytest.raises(ConfigError, match="at least one batch"):
        curve_of(model, [])


def test_a_head_without_knobs_gets_a_sentence(model: Model, batches: list[Batch]) -> None:
    model.head.knobs = {}
    with pytest.raises(ConfigError, match="nothing to trade"):
        curve_of(model, batches)


def made_up(noise: np.ndarray, truth: np.ndarray):
    """Log-likelihoods of seed r: truth plus row r of the noise."""
    return lambda value, seed: torch.from_numpy(truth + noise[seed])


def test_errors_are_numpys() -> None:
    generator = np.random.default_rng(0)
    truth, noise = generator.normal(size=30), generator.normal(0.2, 1, size=(9, 30))
    reference = Reference(99, torch.from_numpy(truth), float(truth.mean()), 0.0, 2)
    point = estimate(made_up(noise, truth), "samples", 3, range(9), reference, 1.5)
    offset = noise.mean(1)
    assert point.error == pytest.approx(np.sqrt(np.mean(offset**2)))
    assert point.bias == pytest.approx(abs(offset.mean()))
    assert point.log_likelihood == pytest.approx(truth.mean() + offset.mean())
    assert point.log_likelihood_sem == pytest.approx(offset.std(ddof=1) / 3)
    assert point.sample_error == pytest.approx(np.sqrt(np.mean(noise**2)))
    assert (point.knob, point.value, point.milliseconds, point.repeats) == ("samples", 3, 1.5, 9)


def test_the_error_of_the_error_is_its_scatter_over_repetitions() -> None:
    """Of many experiments the standard deviation of the error, which the delta method gives from each one."""
    generator = np.random.default_rng(1)
    truth = np.zeros(4)
    reference = Reference(99, torch.zeros(4, dtype=torch.float64), 0.0, 0.0, 2)
    found = []
    for _ in range(300):
        noise = np.repeat(generator.normal(0.5, 0.3, size=(20, 1)), 4, axis=1)
        found.append(estimate(made_up(noise, truth), "samples", 1, range(20), reference, 1.0))
    scatter = np.std([point.error for point in found])
    assert np.mean([point.error_sem for point in found]) == pytest.approx(scatter, rel=0.1)


def test_a_knob_that_changes_nothing_has_error_zero() -> None:
    truth = np.arange(5.0)
    steady = made_up(np.zeros((3, 5)), truth)
    reference = reference_value(steady, 10, range(3))
    assert reference.standard_error == pytest.approx(0, abs=1e-14)
    point = estimate(steady, "samples", 1, range(3), Reference(10, torch.from_numpy(truth), 2.0, 0.0, 3), 1.0)
    assert (point.error, point.error_sem, point.bias, point.sample_error) == (0, 0, 0, 0)


def test_an_infinite_log_likelihood_is_an_infinite_error() -> None:
    truth = np.zeros(3)
    noise = np.zeros((2, 3))
    noise[1, 2] = -math.inf
    reference = Reference(10, torch.zeros(3, dtype=torch.float64), 0.0, 0.0, 2)
    assert estimate(made_up(noise, truth), "samples", 1, range(2), reference, 1.0).error == math.inf


def test_the_reference_averages_densities_and_its_error_is_the_jackknifes() -> None:
    generator = np.random.default_rng(2)
    noise = generator.normal(size=(7, 11))
    found = reference_value(made_up(noise, np.zeros(11)), 50, range(7))
    density = np.exp(noise)
    assert found.log_likelihoods.numpy() == pytest.approx(np.log(density.mean(0)))
    left_out = np.array([np.log(np.delete(density, r, 0).mean(0)).mean() for r in range(7)])
    by_hand = np.sqrt(6 / 7 * np.sum((left_out - left_out.mean()) ** 2))
    assert found.standard_error == pytest.approx(by_hand)
    assert (found.value, found.repeats) == (50, 7)


@pytest.mark.parametrize("level", [-1e4, 1e4])
def test_the_reference_neither_underflows_nor_overflows(level: float) -> None:
    found = reference_value(made_up(np.zeros((3, 2)), np.full(2, level)), 50, range(3))
    assert found.log_likelihood == pytest.approx(level)
    assert found.standard_error == pytest.approx(0, abs=1e-9)


def test_every_value_takes_its_turn() -> None:
    called = []
    found = run_times(called.append, [1, 5, 9], CPU, calls=4, budget_seconds=1e-9)
    # a turn to warm up, and three although the budget is spent
    assert called == [1, 1, 5, 5, 9, 9] * (1 + 3)
    assert len(found) == 3
    called.clear()
    run_times(called.append, [1, 5], CPU, calls=7, budget_seconds=60.0)
    assert called == [1, 1, 5, 5] * (1 + 7)


numbers = st.sampled_from([0.0, 1.0, 1.5, 2.0, 3.0, math.inf, math.nan]) | st.floats(0, 10)


@settings(deadline=None, max_examples=300)
@given(st.lists(st.tuples(numbers, numbers), max_size=12))
def test_the_front_is_what_brute_force_finds(pairs: list[tuple[float, float]]) -> None:
    points = [Point("samples", 1, error, 0.0, time) for error, time in pairs]
    good = [math.isfinite(error) and math.isfinite(time) for error, time in pairs]

    def beats(first: tuple[float, float], second: tuple[float, float]) -> bool:
        return first != second and first[0] <= second[0] and first[1] <= second[1]

    expected = [
        fine and not any(beats(other, pair) for other, sound in zip(pairs, good, strict=True) if sound)
        for pair, fine in zip(pairs, good, strict=True)
    ]
    assert pareto(points) == expected
    assert front([error for error, _ in pairs], [time for _, time in pairs]) == expected


def test_the_file_holds_every_number_under_a_key_with_its_unit(
    model: Model, batches: list[Batch], tmp_path: Path
) -> None:
    curves = {"toy": curve_of(model, batches)}
    path = tmp_path / "work_precision.csv"
    write(curves, path, synthetic=True)
    with path.open(newline="", encoding="utf-8") as file:
        found = list(csv.DictReader(file))
    assert len(found) == 3
    for line, row, point in zip(found, rows(curves, synthetic=True), curves["toy"].points, strict=True):
        assert set(line) == set(row)
        assert float(line["error_nats"]) == point.error
        assert float(line["error_nats_sem"]) == point.error_sem
        assert float(line["milliseconds_per_sample"]) == point.milliseconds
        assert (line["method"], line["knob"], int(line["value"])) == ("toy", "samples", point.value)
        assert (line["synthetic"], line["samples"], line["batch_size"]) == ("true", "60", "25")
    assert [line["pareto"] for line in found] == [str(best).lower() for best in pareto(curves["toy"].points)]
