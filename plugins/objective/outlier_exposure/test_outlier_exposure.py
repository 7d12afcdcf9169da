import math

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special, stats

from framework.configuration.schema import build, resolve
from framework.data import Data, Splits
from framework.datasets.fields import Fields
from framework.errors import ConfigError
from framework.model import Model
from framework.target import Target
from framework.testing.constant import ConstantPredictor
from framework.uncertainty import own_batches
from plugins.objective.outlier_exposure.divergence import (
    DRAWS,
    from_uniform,
    latin_hypercube,
    to_ignorance,
    to_uniform,
)
from plugins.objective.outlier_exposure.objective import OutlierExposure, far_from

CLASSES = Target("class", ("a", "b", "c"))
ANGLE = Target("angle", ("azimuth",))
ANGLES = Target("angle", ("azimuth", "elevation"))
REALS = Target("real", ("x", "y"))
BOX = {"low": -4.0, "high": 4.0}


def head(name, target, **config):
    return build("density_head", resolve("density_head", {"name": name, **config}), target=target)


def objective(**config):
    return build("objective", resolve("objective", {"name": "outlier_exposure", **config}))


def given_batch(count=4, shape=(2,), dtype=torch.float32):
    return {"input": torch.zeros(count, *shape).to(dtype), "target": torch.zeros(count)}


# classes


@settings(deadline=None, max_examples=80)
@given(
    st.lists(st.floats(-1e4, 1e4), min_size=2, max_size=7),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_divergences_of_classes_are_those_of_50_digits(logits, dtype):
    logits = torch.tensor(logits, dtype=dtype)
    density = head("categorical", Target("class", tuple(map(str, range(len(logits))))))(logits)
    with mpmath.workdps(50):
        numbers = [mpmath.mpf(value) for value in logits.tolist()]
        largest = max(numbers)
        log_total = largest + mpmath.log(mpmath.fsum(mpmath.e ** (value - largest) for value in numbers))
        log_prob = [value - log_total for value in numbers]
        count = len(numbers)
        first = float(mpmath.fsum(mpmath.e**value * value for value in log_prob) + mpmath.log(count))
        second = float(-mpmath.fsum(log_prob) / count - mpmath.log(count))
    tolerance = 1e-13 if dtype == torch.float64 else 5e-6
    assert from_uniform(density).item() == pytest.approx(first, rel=tolerance, abs=tolerance)
    assert to_uniform(density).item() == pytest.approx(second, rel=tolerance, abs=tolerance)


def test_the_penalty_is_lambda_times_the_mean_divergence():
    raw = torch.tensor([2.0, -1.0, 0.5], dtype=torch.float64)
    predictor = ConstantPredictor(head("categorical", CLASSES), raw)
    p = special.softmax(raw.numpy())
    penalty = objective(**BOX, weight=0.4)(predictor, given_batch()).item()
    assert penalty == pytest.approx(0.4 * (math.log(3) - stats.entropy(p)), rel=1e-12)
    penalty = objective(**BOX, weight=0.4, divergence="cross_entropy")(predictor, given_batch()).item()
    assert penalty == pytest.approx(0.4 * stats.entropy(np.full(3, 1 / 3), p), rel=1e-12)


def test_members_with_batches_of_their_own_see_the_same_outliers():
    """Check that there are as many outliers as samples in one member's batch."""
    built = iter([Model([], head("categorical", CLASSES), (2,)) for _ in range(3)])
    wrapper = resolve("uncertainty", {"name": "ensemble", "members": 3})
    whole = build("uncertainty", wrapper, model=lambda: next(built), target=CLASSES)
    inputs = torch.randn(15, 2)
    torch.manual_seed(0)
    wanted = objective(**BOX)(whole, {"input": inputs[:5]})
    torch.manual_seed(0)
    with own_batches(whole):
        penalty = objective(**BOX)(whole, {"input": inputs})
        assert whole.own_batches
    torch.testing.assert_close(penalty, wanted, rtol=0, atol=0)


def test_knowing_nothing_costs_nothing():
    for kind in ("entropy", "cross_entropy", "auto"):
        predictor = ConstantPredictor(head("categorical", CLASSES), torch.full((3,), 7.0))
        assert objective(**BOX, divergence=kind)(predictor, given_batch()).item() == pytest.approx(
            0, abs=3e-7
        )
    angle = ConstantPredictor(head("von_mises", ANGLE), torch.zeros(3))
    assert objective(**BOX)(angle, given_batch()).item() == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("kind", ["uniform", "data", "bytes"])
def test_outliers_among_the_data_are_left_out(kind):
    inputs = torch.tensor([[0.0, 0.0], [2.0, 0.0]])
    if kind == "bytes":
        inputs = torch.tensor([[0, 0], [255, 0]], dtype=torch.uint8)
    if kind == "data":
        loss = objective(outliers={"name": "moons"}, clearance=0.7, count=200)
    else:
        edge = {"low": 0.0, "high": 1.0} if kind == "bytes" else BOX
        loss = objective(**edge, clearance=0.7, count=200)
    predictor = ConstantPredictor(head("categorical", CLASSES), torch.randn(3))
    penalty = loss(predictor, {"input": inputs})
    (outliers,) = predictor.recorded
    scale = 255 if kind == "bytes" else 1
    gaps = np.linalg.norm(outliers.numpy()[:, None] - inputs.numpy()[None] / scale, axis=-1).min(1)
    assert 0 < len(outliers) < 200
    assert gaps.min() >= 0.7
    single = objective(**BOX, count=1)(
        predictor, {"input": inputs}
    )  # the same density everywhere: the same mean
    torch.testing.assert_close(penalty, single)
    all_near = objective(**BOX, clearance=100.0)
    assert all_near(predictor, {"input": inputs}).item() == 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [3, 3000])
def test_distances_keep_their_digits_however_far_the_inputs_are_from_zero(size, dtype):
    draws = torch.Generator().manual_seed(0)
    inputs = 100 + torch.rand(64, size, generator=draws, dtype=dtype)
    offsets = torch.randn(40, size, generator=draws, dtype=dtype)
    lengths = torch.linspace(0.005, 0.1, 40, dtype=dtype)[:, None]
    outliers = inputs[:40] + offsets / torch.linalg.vector_norm(offsets, dim=1, keepdim=True) * lengths
    exact = np.linalg.norm(outliers.double().numpy()[:, None] - inputs.double().numpy()[None], axis=-1).min(1)
    assert 10 < (exact >= 0.05).sum() < 30
    np.testing.assert_array_equal(far_from(outliers, inputs, 0.05).numpy(), exact >= 0.05)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_sure_class_still_learns_from_cross_entropy_and_not_from_entropy(dtype):
    slopes = {}
    for kind in ("entropy", "cross_entropy"):
        predictor = ConstantPredictor(
            head("categorical", CLASSES), torch.tensor([1e4, -1e4, 0.0], dtype=dtype)
        )
        value = objective(**BOX, divergence=kind)(predictor, given_batch())
        value.backward()
        assert value.isfinite() and predictor.raw.grad.isfinite().all()
        slopes[kind] = predictor.raw.grad.abs().max().item()
    assert slopes["entropy"] == 0.0  # p log p is flat where p is 0 or 1
    assert slopes["cross_entropy"] == pytest.approx(2 / 3)  # p - 1/K


def test_the_gradient_is_that_of_eq_2_21():
    """Check that the constant log K has no gradient."""
    raw = torch.randn(3, dtype=torch.float64)
    predictor = ConstantPredictor(head("categorical", CLASSES), raw.clone())
    objective(**BOX)(predictor, given_batch()).backward()
    own = raw.clone().requires_grad_()
    p = own.softmax(-1)
    (p * p.log()).sum().backward()
    torch.testing.assert_close(predictor.raw.grad, own.grad, rtol=1e-12, atol=1e-14)


# continuous


@pytest.mark.parametrize("count, numbers", [(3, 1), (2, 4)])
def test_places_are_one_in_each_share(count, numbers):
    place = latin_hypercube((count, numbers), torch.device("cpu"))
    assert place.shape == (DRAWS, count, numbers)
    shares = (place * DRAWS).long().sort(0).values
    assert (shares == torch.arange(DRAWS)[:, None, None]).all()


def require_mean(density, scale, wanted, rows):
    """Return whether the mean over many independent estimates of one divergence equals the divergence."""
    divergence = to_ignorance(density, scale).double().numpy()
    assert len(divergence) == rows
    assert divergence.mean() == pytest.approx(wanted, abs=5 * divergence.std() / rows**0.5 + 1e-9)
    return divergence.std()


@pytest.mark.parametrize("concentration", [1e-3, 0.7, 5.0, 80.0])
def test_of_a_von_mises_density(concentration):
    """Check KL(u ‖ p) = log I₀(κ), since the mean of the cosine over a turn is 0."""
    torch.manual_seed(0)
    density = von_mises(concentration, rows=4000)
    wanted = float(mpmath.log(mpmath.besseli(0, concentration)))
    spread = require_mean(density, 1.0, wanted, 4000)
    plain = concentration / math.sqrt(2 * DRAWS)  # of as many independent angles
    assert spread < 0.2 * plain + 1e-9


def von_mises(concentration, rows):
    """Return the head's density whose concentration is nearest to this one, by bisection over raw parameters."""
    build_one = head("von_mises", ANGLE)
    low, high = 0.0, 1e3

    def density(size):
        raw = torch.tensor([size, 0.0, size], dtype=torch.float64)
        return build_one(raw[: build_one.size].expand(rows, build_one.size))

    # log p at the mode minus at the antipode is 2κ
    def concentration_of(size):
        candidate = density(size)
        mode = candidate.mode
        return ((candidate.log_prob(mode) - candidate.log_prob(mode + math.pi))[0] / 2).item()

    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if concentration_of(middle) < concentration else (low, middle)
    assert concentration_of(low) == pytest.approx(concentration, rel=1e-6)
    return density(low)


def test_of_two_angles_it_is_the_sum():
    torch.manual_seed(0)
    raw = torch.randn(6, dtype=torch.float64)
    pair = head("von_mises", ANGLES)
    density = pair(raw.expand(4000, 6))
    places = np.linspace(-math.pi, math.pi, 200, endpoint=False)
    grid = torch.from_numpy(np.stack(np.meshgrid(places, places, indexing="ij"), -1).reshape(-1, 1, 2))
    wanted = -pair(raw[None]).log_prob(grid).mean().item() - 2 * math.log(2 * math.pi)
    require_mean(density, 1.0, wanted, 4000)


@pytest.mark.parametrize("mean, deviation, scale", [(0.0, 3.0, 3.0), (1.5, 0.4, 2.0), (-30.0, 5.0, 0.1)])
def test_the_divergence_of_a_gaussian_is_its_closed_form(mean, deviation, scale):
    """Check KL(N(0, s²) ‖ N(μ, σ²)) = log σ/s + (s² + μ²) / 2σ² - 1/2 for each number."""
    torch.manual_seed(0)
    density = torch.distributions.Independent(
        torch.distributions.Normal(
            torch.full((4000, 2), mean, dtype=torch.float64), torch.tensor(deviation, dtype=torch.float64)
        ),
        1,
    )
    wanted = 2 * (math.log(deviation / scale) + (scale**2 + mean**2) / (2 * deviation**2) - 0.5)
    require_mean(density, scale, wanted, 4000)


def test_rotations_at_random_cost_nothing_and_others_more():
    torch.manual_seed(0)
    viewpoint = Target("angle", ("azimuth", "elevation", "tilt"))
    rotations = head("matrix_fisher", viewpoint)
    raw = torch.zeros(2000, rotations.size, dtype=torch.float64)
    start = torch.zeros(rotations.size, dtype=torch.float64, requires_grad=True)
    cost = to_ignorance(rotations(raw + start), 1.0)
    torch.testing.assert_close(cost, torch.zeros_like(cost), rtol=0, atol=1e-9)
    (slope,) = torch.autograd.grad(cost.mean(), start)
    assert slope.abs().max() < 0.02  # chance alone: 2000 × 16 rotations
    for _ in range(5):
        other = rotations(raw + 0.5 * torch.randn(rotations.size, dtype=torch.float64))
        assert to_ignorance(other, 1.0).mean() > 0.02


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "name, target", [("von_mises", ANGLE), ("von_mises", ANGLES), ("gaussian", REALS), ("mixture", ANGLE)]
)
@pytest.mark.parametrize("size", [0.0, 1.0, 1e4])
def test_extreme_densities_have_a_finite_divergence_and_gradient(name, target, size, dtype):
    torch.manual_seed(0)
    density_head = head(name, target)
    predictor = ConstantPredictor(density_head, size * torch.randn(density_head.size, dtype=dtype))
    value = objective(**BOX)(predictor, given_batch())
    value.backward()
    assert value.isfinite() and value.dtype == dtype
    assert predictor.raw.grad.isfinite().all()


# members


def test_members_train_as_if_alone():
    torch.manual_seed(0)
    raw = torch.randn(3, 3, dtype=torch.float64)
    together = ConstantPredictor(head("categorical", CLASSES), raw.clone(), members=True)
    value = objective(**BOX)(together, given_batch())
    value.backward()
    alone = []
    for index, member in enumerate(raw):
        predictor = ConstantPredictor(head("categorical", CLASSES), member.clone())
        alone.append(objective(**BOX)(predictor, given_batch()))
        alone[-1].backward()
        torch.testing.assert_close(together.raw.grad[index], predictor.raw.grad, rtol=1e-12, atol=1e-14)
    assert value.item() == pytest.approx(torch.stack(alone).mean().item(), rel=1e-12)


# where outliers come from


class Unread(torch.utils.data.Dataset):
    """A split that must not be read."""

    def __getitem__(self, index):
        raise AssertionError("training alone is drawn from")

    __len__ = __getitems__ = __getitem__


class Tiny(Data):
    """A data set of ten inputs of value 0 to 9; augmentation adds a half."""

    def __init__(self, shape=(2,)):
        self.input_shape = shape
        self.prepared = 0

    def prepare(self):
        self.prepared += 1
        inputs = torch.arange(10.0).reshape(10, *[1] * len(self.input_shape)).expand(10, *self.input_shape)
        self.table = Fields(input=inputs.contiguous(), target=torch.zeros(10), index=torch.arange(10))

    def splits(self):
        assert self.prepared
        return Splits(self.table, Unread(), Unread())

    def augment(self, batch):
        return {**batch, "input": batch["input"] + 0.5}

    def read(self, files):
        raise AssertionError("nothing is read")

    def fingerprint(self):
        return {}

    def preview(self, inputs):
        raise AssertionError("nothing is shown")


class OneByOne(torch.utils.data.Dataset):
    """A data set that cannot fetch many items at once."""

    def __init__(self, table):
        self.table = table

    def __len__(self):
        return len(self.table)

    def __getitem__(self, index):
        return self.table[index]


@pytest.mark.parametrize("one_by_one", [False, True])
def test_outliers_are_drawn_from_the_training_split_and_augmented(one_by_one):
    data = Tiny()
    exposure = OutlierExposure(outliers=data, count=500)
    assert data.prepared == 1
    if one_by_one:
        exposure.split = OneByOne(data.table)
    predictor = ConstantPredictor(head("categorical", CLASSES), torch.zeros(3))
    torch.manual_seed(3)
    exposure(predictor, given_batch())
    exposure(predictor, given_batch())
    torch.manual_seed(3)
    exposure(predictor, given_batch())
    first, second, again = predictor.recorded
    assert first.shape == (500, 2)
    assert set(first[:, 0].tolist()) == {index + 0.5 for index in range(10)}
    assert torch.equal(first, again) and not torch.equal(first, second)
    counts = np.bincount(first[:, 0].long().numpy(), minlength=10)
    assert stats.chisquare(counts).pvalue > 1e-4


def test_there_are_as_many_outliers_as_samples_unless_told():
    predictor = ConstantPredictor(head("categorical", CLASSES), torch.zeros(3))
    for source in ({"outliers": Tiny()}, BOX):
        for wanted, count in ((4, None), (9, 9)):
            OutlierExposure(**source, count=count)(predictor, given_batch(4))
            assert len(predictor.recorded[-1]) == wanted
        assert OutlierExposure(**source)(predictor, given_batch(0)).item() == 0.0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.uint8])
def test_uniform_numbers_fill_their_range(dtype):
    predictor = ConstantPredictor(head("categorical", CLASSES), torch.zeros(3))
    torch.manual_seed(0)
    OutlierExposure(low=0.0, high=1.0, count=300)(predictor, given_batch(4, (3, 4, 4), dtype))
    noise = predictor.recorded[0]
    assert noise.shape == (300, 3, 4, 4)
    assert noise.dtype == (dtype if dtype.is_floating_point else torch.float32)
    assert stats.kstest(noise.flatten().double().numpy(), "uniform").pvalue > 1e-4


def test_batch_norm_sees_outliers_as_in_a_test_and_learns_nothing_of_them():
    torch.manual_seed(0)
    mlp = resolve("encoder", {"name": "mlp", "widths": [8], "batch_norm": True})
    encoder = build("encoder", mlp, input_shape=(2,))
    predictor = Model([encoder], head("categorical", CLASSES))
    predictor.loss(torch.randn(64, 2), torch.randint(3, (64,)))
    moments = {name: value.clone() for name, value in predictor.named_buffers()}
    torch.manual_seed(1)
    penalty = objective(**BOX)(predictor, given_batch(16)).item()
    assert predictor.training and encoder.training
    for name, value in predictor.named_buffers():
        assert torch.equal(value, moments[name]), name
    torch.manual_seed(1)
    outliers = -4 + 8 * torch.rand(16, 2)
    predictor.eval()
    wanted = from_uniform(predictor(outliers)).mean().item()
    assert penalty == pytest.approx(wanted, rel=1e-6)


def test_a_network_learns_to_know_nothing_outside_its_data():
    """Train on two blobs (thesis Fig. 2.3 (f)): classes kept apart at their centres, entropy log 2 in corners."""
    entropies = {}
    for exposed in (False, True):
        torch.manual_seed(0)
        mlp = resolve("encoder", {"name": "mlp", "widths": [64, 64]})
        encoder = build("encoder", mlp, input_shape=(2,))
        predictor = Model([encoder], head("bernoulli", Target("class", ("off", "on"))))
        target = torch.arange(200) % 2
        batch = {"input": 0.3 * torch.randn(200, 2) + 2 * target[:, None] - 1, "target": target}
        optimizer = torch.optim.Adam(predictor.parameters(), 1e-2)
        penalty = objective(**BOX)
        for _ in range(250):
            optimizer.zero_grad()
            loss = predictor.loss(batch["input"], target).mean()
            (loss + penalty(predictor, batch) if exposed else loss).backward()
            optimizer.step()
        with torch.no_grad():
            assert (predictor(batch["input"]).mode == target).double().mean() > 0.97
            corners = torch.tensor([[-3.5, -3.5], [3.5, 3.5], [3.5, -3.5], [-3.5, 3.5]])
            entropies[exposed] = predictor(corners).entropy()
    assert entropies[False].min() < 0.01
    assert entropies[True].min() > 0.6


# refused


@pytest.mark.parametrize(
    "config, message",
    [
        ({}, "got no source of outliers. Set either outliers"),
        ({"low": 0.0}, "got low = 0. Set either"),
        ({"high": 1.0}, "got high = 1. Set either"),
        ({"low": 1.0, "high": 1.0}, "low is 1 and high is 1, but low must be below high"),
        (
            {"outliers": Tiny(), "low": 0.0, "high": 1.0},
            "got low = 0 and high = 1 and outliers. Set either",
        ),
        ({"outliers": Tiny(), "high": 1.0}, "got high = 1 and outliers. Set either"),
    ],
)
def test_one_source_of_outliers_is_wanted(config, message):
    with pytest.raises(ConfigError, match=message):
        OutlierExposure(**config)


def test_outliers_of_another_shape_are_refused():
    predictor = ConstantPredictor(head("categorical", CLASSES), torch.zeros(3))
    with pytest.raises(ConfigError, match=r"inputs of shape \(3,\), but the data has inputs of shape \(2,\)"):
        OutlierExposure(outliers=Tiny((3,)))(predictor, given_batch())


def test_entropy_of_a_continuous_density_is_refused():
    predictor = ConstantPredictor(head("gaussian", REALS), torch.zeros(4))
    with pytest.raises(ConfigError, match="is for classes, but the density is over 2 continuous numbers"):
        objective(**BOX, divergence="entropy")(predictor, given_batch())


def test_a_config_names_the_data_to_draw_from():
    exposure = objective(outliers={"name": "moons", "train": 20}, count=3)
    predictor = ConstantPredictor(head("categorical", CLASSES), torch.zeros(3))
    exposure(predictor, given_batch())
    outliers, known = predictor.recorded[0], exposure.outliers.splits().train.fields["input"]
    assert outliers.shape == (3, 2)
    assert all((known == outlier).all(1).any() for outlier in outliers)
    with pytest.raises(ConfigError, match="No data is called 'moon'"):
        objective(outliers={"name": "moon"})


@pytest.mark.parametrize(
    "config",
    [{"weight": 0.0}, {"count": 0}, {"prior_scale": 0.0}, {"divergence": "kl"}, {"low": float("nan")}],
)
def test_refuses_a_config_out_of_range(config):
    with pytest.raises(ConfigError, match=r"objective\."):
        resolve("objective", {"name": "outlier_exposure", **config})
