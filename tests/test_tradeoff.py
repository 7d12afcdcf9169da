"""Error against run time for the values of a knob, compared with closed forms and brute force."""

import math
from collections.abc import Iterator, Sequence
from csv import DictReader
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.distributions import Independent, Normal

from framework.configuration.schema import build, resolve
from framework.data import Batch
from framework.density_head import DensityHead
from framework.distributions.density import Mixture
from framework.encoder import Encoder
from framework.errors import ConfigError
from framework.evaluation.pareto import TIME_NOISE, front
from framework.evaluation.significance import Mean, least_significant, mean
from framework.evaluation.tradeoff import Curve, Point, first_knob, knob_owners, rows, run_times, tradeoff
from framework.model import Model
from framework.reports.table import write_csv
from framework.target import Target

CPU = torch.device("cpu")
TARGET = Target("class", ("a", "b"))


def predictor(*wrappers, head="bernoulli", target=TARGET):
    def model():
        encoder = resolve("encoder", {"name": "mlp", "widths": [8], "dropout": 0.5})
        built = build("encoder", encoder, input_shape=(2,))
        return Model([built], build("density_head", resolve("density_head", head), target=target))

    torch.manual_seed(0)
    make = model
    for wrapper in wrappers:
        make = partial(build, "uncertainty", resolve("uncertainty", wrapper), model=make, target=target)
    return make().eval()


def batches():
    generator = torch.Generator().manual_seed(0)
    inputs = torch.randn(60, 2, generator=generator)
    fields = {"input": inputs, "target": (inputs[:, 0] > 0).long(), "index": torch.arange(60)}
    fields["group"] = torch.zeros(60, dtype=torch.int64)
    return [{name: field[start : start + 20] for name, field in fields.items()} for start in (0, 20, 40)]


def metrics():
    return [build("metric", resolve("metric", "nll"), target=TARGET)]


def tradeoff_of(whole, knob, values, repeats):
    options = {"samples": 1, "seed": 0, "repeats": repeats, "timed_calls": 3}
    return tradeoff(whole, batches(), metrics(), knob=knob, values=values, **options)


def test_each_value_gives_the_metric_of_the_predictor_so_set():
    whole = predictor({"name": "ensemble", "members": 3})
    curve = tradeoff_of(whole, "members", (1, 3), repeats=2)
    assert whole.members == 3  # as before
    assert [point.value for point in curve.points] == [1, 3]
    for point in curve.points:
        whole.members = point.value
        with torch.no_grad():
            nll = [-whole(batch["input"]).log_prob(batch["target"]) for batch in batches()]
        assert point.numbers["nll"] == pytest.approx(torch.cat(nll).double().mean().item(), rel=1e-6)
        assert point.numbers["nll_std"] == 0  # nothing is drawn
        assert point.milliseconds > 0


def test_repeats_differ_where_something_is_drawn():
    whole = predictor({"name": "mc_dropout", "samples": 4})
    state = torch.get_rng_state()
    curve = tradeoff_of(whole, "samples", (1, 30), repeats=6)
    assert torch.equal(torch.get_rng_state(), state)
    assert whole.samples == 4
    few, many = curve.points
    assert few.numbers["nll_std"] > 2 * many.numbers["nll_std"] > 0
    assert (curve.knob, curve.repeats, curve.samples, curve.batch_size) == ("samples", 6, 60, 20)


def test_the_wrappers_knob_hides_a_heads_of_the_same_name():
    angle = Target("angle", ("azimuth",))
    whole = predictor({"name": "mc_dropout"}, head="scvae", target=angle)
    assert knob_owners(whole, "samples") == [whole]
    assert knob_owners(predictor(head="scvae", target=angle), "samples")[0].knobs
    assert knob_owners(whole, "") == []
    with pytest.raises(ConfigError, match="Did you mean 'samples'"):
        knob_owners(whole, "sample")
    with pytest.raises(ConfigError, match="Got no batch"):
        tradeoff(whole, [], metrics(), knob="samples", values=(1,), samples=1, seed=0)
    assert first_knob(whole) == "samples"
    with pytest.raises(ConfigError, match="trade error for run time"):
        first_knob(predictor())


class Counting(Encoder):
    """Encoder of two numbers that counts its calls."""

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
def pairs() -> list[Batch]:
    generator = torch.Generator().manual_seed(1)
    inputs = torch.randn(60, 2, generator=generator)
    target = inputs[:, :1] + 2**0.5 * torch.randn(60, 1, generator=generator)
    return [{"input": inputs[i : i + 25], "target": target[i : i + 25]} for i in range(0, 60, 25)]


def curve_of(model: Model, pairs: list[Batch], **changed):
    options = {"knob": "samples", "values": (1, 10, 100), "reference": 2000, "repeats": 6, "seed": 5}
    return tradeoff(model, pairs, **(options | changed), timed_calls=1, budget_seconds=1.0)


def numbers(curve: Curve, key: str) -> list[float]:
    return [point.numbers[key] for point in curve.points]


def exact(pairs: list[Batch]) -> float:
    inputs = torch.cat([batch["input"] for batch in pairs]).double().numpy()
    target = torch.cat([batch["target"] for batch in pairs]).double().numpy()
    residual = target[:, 0] - inputs[:, 0]
    return float(np.mean(-0.25 * residual**2 - 0.5 * np.log(4 * np.pi)))  # log N(residual; 0, variance 2)


def test_the_reference_is_the_exact_log_likelihood_within_its_error(model: Model, pairs: list[Batch]) -> None:
    reference = curve_of(model, pairs).reference
    assert 0 < reference.standard_error < 0.01
    assert abs(reference.mean - exact(pairs)) < 4 * reference.standard_error
    assert reference.log_probs.shape == (60,)


def test_errors_fall_as_samples_grow_and_start_at_the_exact_bias(model: Model, pairs: list[Batch]) -> None:
    curve = curve_of(model, pairs, repeats=12)
    for key in ("error_nats", "sample_error_nats"):
        one, ten, hundred = numbers(curve, key)
        assert one > ten > hundred
    # one sample: E log N(r; z, 1) = -(r² + 1)/2 - log(2π)/2
    residual = torch.cat([batch["target"] - batch["input"][:, :1] for batch in pairs]).double()
    expected = float((-(residual**2 + 1) / 2).mean()) - 0.5 * math.log(2 * math.pi)
    first = curve.points[0].numbers
    error = first["log_likelihood_nats_sem"]
    assert abs(first["log_likelihood_nats"] - expected) < 4 * error
    assert first["bias_nats"] == pytest.approx(abs(expected - exact(pairs)), abs=4 * error + 0.01)
    assert [point.value for point in curve.points] == [1, 10, 100]


def test_the_same_seed_gives_the_same_errors_and_another_does_not(model: Model, pairs: list[Batch]) -> None:
    first, again, other = (curve_of(model, pairs, seed=seed) for seed in (1, 1, 2))
    assert numbers(first, "error_nats") == numbers(again, "error_nats")
    assert numbers(first, "error_nats")[0] != numbers(other, "error_nats")[0]


def test_model_knob_mode_and_random_numbers_are_left_alone(model: Model, pairs: list[Batch]) -> None:
    model.train()
    before = torch.get_rng_state()
    curve_of(model, pairs)
    assert model.head.samples == 7
    assert model.training
    assert torch.equal(torch.get_rng_state(), before)


def test_after_an_error_everything_is_left_alone_too(model: Model, pairs: list[Batch]) -> None:
    model.train()
    pairs[0]["target"][3] = math.inf
    with pytest.raises(ValueError, match=r"sample 3 is -inf \(1 samples"):
        curve_of(model, pairs)
    assert model.head.samples == 7
    assert model.training


def test_the_encoder_runs_once_for_the_errors_and_each_time_for_the_times(
    model: Model, pairs: list[Batch]
) -> None:
    curve_of(model, pairs)
    values, turns, calls_a_turn = 3, 1 + 1, 2
    assert model.encoders[0].calls == len(pairs) + values * turns * calls_a_turn


def test_batches_may_come_once(model: Model, pairs: list[Batch]) -> None:
    def once() -> Iterator[Batch]:
        yield from pairs

    assert curve_of(model, once()).samples == 60


def test_no_two_estimates_share_random_numbers(model: Model, pairs: list[Batch]) -> None:
    """Estimates with equal knob values would be equal if they shared random numbers."""
    found = curve_of(model, pairs, values=(10, 10), reference=10, repeats=2)
    assert len({*numbers(found, "log_likelihood_nats"), found.reference.mean}) == 3


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"knob": "sample"}, "a knob 'sample'. Did you mean 'samples'"),
        ({"reference": 99}, "below the largest value of the curve, 100"),
        ({"repeats": 1}, "at least 2 are required"),
        ({"values": ()}, r"for example \(1, 10, 100\) for Convolved"),
    ],
)
def test_wrong_wishes_get_a_sentence(model: Model, pairs: list[Batch], changed: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        curve_of(model, pairs, **changed)


def test_no_batches_get_a_sentence(model: Model) -> None:
    with pytest.raises(ConfigError, match="Got no batch"):
        curve_of(model, [])


def test_a_head_without_knobs_gets_a_sentence(model: Model, pairs: list[Batch]) -> None:
    model.head.knobs = {}
    with pytest.raises(ConfigError, match="trade error for run time"):
        curve_of(model, pairs)


def test_every_value_takes_its_turn() -> None:
    called = []
    found = run_times(called.append, [1, 5, 9], CPU, calls=4, budget_seconds=1e-9)
    # a turn to warm up, and three although the budget is spent
    assert called == [1, 1, 5, 5, 9, 9] * (1 + 3)
    assert len(found) == 3
    called.clear()
    run_times(called.append, [1, 5], CPU, calls=7, budget_seconds=60.0)
    assert called == [1, 1, 5, 5] * (1 + 7)


def known(errors: Sequence[float], noise: Sequence[float]) -> list[Mean]:
    """Return means over many samples."""
    return [Mean(error, its, math.inf, "samples") for error, its in zip(errors, noise, strict=True)]


some = st.sampled_from([0.0, 1.0, 1.5, 2.0, 3.0, math.inf, math.nan]) | st.floats(0, 10)


@settings(deadline=None, max_examples=300)
@given(st.lists(st.tuples(some, some), max_size=12))
def test_the_front_is_what_brute_force_finds(pairs: list[tuple[float, float]]) -> None:
    good = [math.isfinite(error) and math.isfinite(time) for error, time in pairs]

    def beats(first: tuple[float, float], second: tuple[float, float]) -> bool:
        return first != second and first[0] <= second[0] and first[1] <= second[1]

    expected = [
        fine and not any(beats(other, pair) for other, sound in zip(pairs, good, strict=True) if sound)
        for pair, fine in zip(pairs, good, strict=True)
    ]
    assert front([error for error, _ in pairs], [time for _, time in pairs]) == expected


@settings(deadline=None, max_examples=300)
@given(st.lists(st.tuples(some, some, st.floats(0, 3)), max_size=9), st.sampled_from([0.0, 0.05, 0.5]))
def test_beyond_noise_no_two_hide_each_other_and_each_hidden_one_is_beaten(
    points: list[tuple[float, float, float]], times_apart: float
) -> None:
    errors, times, noise = (list(column) for column in zip(*points, strict=True)) if points else ([], [], [])
    means = known(errors, noise)
    kept = front(means, times, times_apart)
    apart = least_significant(means)

    def beats(one: int, other: int) -> bool:
        """Written out: better in one beyond noise, and not worse in the other."""
        least = apart[one, other]
        less, more = errors[one] + least < errors[other], errors[other] + least < errors[one]
        faster = times[one] * (1 + times_apart) < times[other]
        slower = times[other] * (1 + times_apart) < times[one]
        return (less and not slower) or (faster and not more)

    finite = [place for place in range(len(points)) if math.isfinite(errors[place] + times[place])]
    inside = [place for place in finite if kept[place]]
    assert [place for place, one in enumerate(kept) if one] == inside
    assert bool(inside) is bool(finite)
    for place in finite:
        beating = [one for one in inside if beats(one, place)]
        assert not (set(beating) & {one for one in finite if beats(place, one)})  # never both
        assert bool(beating) is (place not in inside)
    again = front(means[::-1], times[::-1], times_apart)
    assert again[::-1] == kept  # whatever the order


@pytest.mark.parametrize(
    ("points", "wanted"),
    [
        ([(0.0060, 0.002, 2.65), (0.0047, 0.0012, 3.59)], "01"),  # dearer, and no better beyond noise
        ([(0.0060, 0.0002, 2.65), (0.0047, 0.0001, 3.59)], "00"),  # better beyond noise
        ([(0.10, 0.02, 1.81), (0.12, 0.03, 1.78)], "00"),  # alike: neither hides the other
        ([(5.3, 1.0, 1.65), (0.12, 0.03, 1.69)], "10"),  # 2 % of time is noise, the error is not
        ([(1.0, 0.1, 1.0), (0.8, 0.1, 2.0), (0.6, 0.1, 3.0)], "010"),  # only a beaten one beats the last
        ([(1.0, math.nan, 1.0), (0.99, math.nan, 2.0)], "11"),  # errors not known: no front
        ([(1.0, 0.1, 1.0), (0.5, 0.1, 2.0), (9.0, math.nan, 9.0)], "111"),
    ],
)
def test_rings_stand_beyond_noise(points: list[tuple[float, float, float]], wanted: str) -> None:
    """`wanted`: 1 where a point is hidden."""
    errors, noise, times = zip(*points, strict=True)
    assert front(known(errors, noise), times, TIME_NOISE) == [hidden == "0" for hidden in wanted]


def drawn_from(*points: tuple[int, float, float]) -> Curve:
    made = [Point(value, {"nll": nll, "nll_std": 1e-9, "brier": 1.0}, time) for value, nll, time in points]
    return Curve("members", made, None, 2, 60, 20, "cpu", 1)


def test_rows_say_which_points_no_other_beats():
    curve = drawn_from((1, 0.5, 1.0), (2, 0.6, 2.0), (3, 0.4, 3.0))
    found = rows({"x": curve}, {"nll": "lower"}, synthetic=True)
    assert [row["nll_pareto"] for row in found] == [True, False, True]
    assert "brier" not in found[0]
    found = rows({"x": curve}, {"nll": "higher"}, synthetic=True)
    assert [row["nll_pareto"] for row in found] == [True, True, False]


def test_the_file_holds_every_number_under_a_key_with_its_unit(
    model: Model, pairs: list[Batch], tmp_path: Path
) -> None:
    curves = {"toy": curve_of(model, pairs)}
    path = tmp_path / "work_precision.csv"
    table = rows(curves, {"error_nats": "lower"}, synthetic=True)
    write_csv(table, None, path)
    with path.open(newline="", encoding="utf-8") as file:
        found = list(DictReader(file))
    assert len(found) == 3
    for line, row, point in zip(found, table, curves["toy"].points, strict=True):
        assert set(line) == set(row)
        for key, number in point.numbers.items():
            assert float(line[key]) == number
        assert float(line["milliseconds_per_sample"]) == point.milliseconds
        assert (line["method"], line["knob"], int(line["value"])) == ("toy", "samples", point.value)
        assert (line["synthetic"], line["samples"], line["batch_size"]) == ("true", "60", "25")
        assert (line["repeats"], line["reference_value"]) == ("6", "2000")
    times = [point.milliseconds for point in curves["toy"].points]
    means = [mean({**point.numbers, "repeats": 6}, "error_nats", 6) for point in curves["toy"].points]
    best = front(means, times, TIME_NOISE)
    assert [line["error_nats_pareto"] for line in found] == [str(one).lower() for one in best]


@pytest.mark.slow
def test_metrics_and_errors_against_a_reference_are_measured_together() -> None:
    angle = Target("angle", ("azimuth",))
    whole = predictor({"name": "mc_dropout"}, head={"name": "scvae", "samples": 20}, target=angle)
    fields = [{**batch, "target": batch["input"][:, :1]} for batch in batches()]
    metric = build("metric", resolve("metric", "angular_deviation"), target=angle)
    options = {"knob": "samples", "values": (1, 20), "repeats": 3, "timed_calls": 1}
    together = tradeoff(whole, fields, [metric], reference=100, **options)
    for key in ("maad_deg", "maad_deg_std"):
        assert numbers(together, key) == numbers(tradeoff(whole, fields, [metric], **options), key)
    alone = tradeoff(whole, fields, reference=100, **options)
    assert set(alone.points[0].numbers) < set(together.points[0].numbers)
    assert numbers(together, "error_nats") == numbers(alone, "error_nats")
    assert numbers(together, "sample_error_nats")[0] > numbers(together, "sample_error_nats")[1]
