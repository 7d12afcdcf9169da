import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize, stats
from torch.distributions import Categorical, Independent, MultivariateNormal, Normal

from framework.configuration.schema import build, resolve
from framework.distributions.affine import AffineDensity
from framework.distributions.batch_shapes import Reshaped, Stacked
from framework.distributions.density import Mixture, circular_grid
from framework.distributions.protocol import estimate, marginal, median, mode_candidates, peak_widths
from framework.distributions.tempering import temper
from framework.errors import UserError
from framework.target import Target
from framework.testing.metrics import Cardioid
from plugins.uncertainty.conformal.highest_density import Line
from plugins.uncertainty.conformal.prediction_set import PredictionSet

EVERYTHING = torch.tensor(math.inf, dtype=torch.float64)
TURN = 2 * math.pi
ITEMS = 4


def hot(value):
    return torch.tensor(value, dtype=torch.float64)


def normal(place, spread, dtype=torch.float64):
    place, spread = (torch.tensor(part, dtype=dtype).reshape(-1, 1) for part in (place, spread))
    return Independent(Normal(place, spread.expand_as(place), validate_args=False), 1, validate_args=False)


def von_mises(mean, concentration, dtype=torch.float64):
    """Return the plugin's density by name, without raw parameters."""
    kind = type(build_head("von_mises")(torch.zeros(1, 3)))
    mean, concentration = (torch.tensor(part, dtype=dtype).reshape(-1, 1) for part in (mean, concentration))
    return kind(mean, concentration.expand_as(mean))


def build_head(name, target=None):
    return build(
        "density_head", resolve("density_head", name), target=target or Target("angle", ("azimuth",))
    )


DENSITIES = {
    "classes": Categorical(logits=torch.randn(4, 3), validate_args=False),
    "angle": Cardioid(torch.randn(4, 1)),
    "mixture of angles": Mixture(torch.randn(4, 2), Cardioid(torch.randn(4, 2, 1))),
    "real": normal([0.3, -2.0, 7.0, 0.0], [1.0, 0.1, 3.0, 1.0], torch.float32),
    "reals": MultivariateNormal(torch.randn(4, 2).double(), torch.eye(2).double(), validate_args=False),
}


@pytest.mark.parametrize("kind", DENSITIES)
@pytest.mark.parametrize("score", ["density", "mass"])
def test_the_density_is_kept_to_the_last_bit(kind, score):
    density = DENSITIES[kind]
    whole = PredictionSet(density, hot(1.0), score)
    torch.manual_seed(1)
    value = density.sample((3,))
    torch.manual_seed(1)
    assert torch.equal(whole.sample((3,)), value)
    log_prob = whole.log_prob(value)
    assert log_prob.dtype == density.log_prob(value).dtype and torch.equal(log_prob, density.log_prob(value))
    assert torch.equal(whole.mode, density.mode)
    torch.manual_seed(2)
    wanted = density.entropy()
    torch.manual_seed(2)
    assert torch.equal(whole.entropy(), wanted)
    torch.manual_seed(2)
    wanted = median(density, 50)
    torch.manual_seed(2)
    assert torch.equal(median(whole, 50), wanted)
    assert whole.contains(value).shape == (3, 4) and whole.scores(value).dtype == torch.float64
    assert not isinstance(
        temper(whole, hot(2.0)), PredictionSet
    )  # a wrapper around it keeps densities, not sets


def test_estimates_and_marginals_are_those_of_the_density():
    head = build_head("scvae").eval()
    head.samples = 16
    with torch.no_grad():
        sampled = head(torch.randn(4, head.size))
    result = estimate(PredictionSet(sampled, hot(1.0), "density"), torch.zeros(4, 1))
    assert (result.standard_error > 0).all()
    assert torch.equal(result.standard_error, estimate(sampled, torch.zeros(4, 1)).standard_error)
    several = PredictionSet(Cardioid(torch.randn(4, 3)), hot(1.0), "density")
    assert type(marginal(several, 1)) is Cardioid
    single = PredictionSet(Cardioid(torch.randn(4, 1)), hot(1.0), "density")
    assert marginal(single, 0) is single


def test_density_sets_of_classes_are_those_above_the_level():
    density = Categorical(probs=torch.tensor([[0.6, 0.3, 0.1], [0.4, 0.35, 0.25]]), validate_args=False)
    sets = PredictionSet(density, -hot(0.3).log() + 1e-6, "density")
    assert sets.labels().tolist() == [[True, True, False], [True, True, False]]
    assert sets.size().tolist() == [2.0, 2.0]
    strict = PredictionSet(density, -hot(0.5).log(), "density")
    assert strict.labels().tolist() == [[True, False, False], [False, False, False]]
    assert strict.empty().tolist() == [False, True]
    assert PredictionSet(density, EVERYTHING, "mass").labels().all()


def test_mass_scores_of_classes_by_a_loop():
    """Compare with -log(Σ_j p_j + (1 - u) p(y)) over the less probable labels j, with u of the two likeliest labels."""
    torch.manual_seed(4)
    density = Categorical(logits=4 * torch.randn(50, 5).double(), validate_args=False)
    scores = PredictionSet(density, EVERYTHING, "mass").scores(density.enumerate_support())
    for item, row in enumerate(density.probs.tolist()):
        best, second = sorted(row, reverse=True)[:2]
        step = round(1000 * math.log1p(math.log(best) - math.log(second)))
        share = min(max((step * (math.sqrt(5) - 1) / 2) % 1, 1e-6), 1 - 1e-6)
        for label, own in enumerate(row):
            wanted = -math.log(sum(other for other in row if other < own) + (1 - share) * own)
            assert scores[label, item].item() == pytest.approx(wanted, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("score", ["density", "mass"])
@pytest.mark.parametrize("size", [1e4, 1e30, math.inf])
def test_certain_classes_have_scores_that_are_numbers(score, size):
    logits = torch.tensor([[size, 0.0], [0.0, size], [0.0, 0.0]])
    if math.isinf(size):
        logits = torch.tensor([[0.0, -size], [-size, 0.0], [0.0, 0.0]])
    density = Categorical(logits=logits.log_softmax(-1), validate_args=False)
    scores = PredictionSet(density, EVERYTHING, score).scores(density.enumerate_support())
    assert not scores.isnan().any()
    assert (scores.diagonal()[:2] < 20).all() and (scores[[1, 0], [0, 1]] >= 1e4).all()


CONCENTRATIONS = [0.01, 0.5, 5.0, 1e4, 1e8, 1e12]


@pytest.mark.parametrize("concentration", CONCENTRATIONS)
def test_arcs_of_one_level(concentration):
    """Check that log p falls by 1 nat where κ (1 - cos d) = 1."""
    density = von_mises([3.1, 0.0, -40.0], concentration)
    level = -density.log_prob(density.mode)[0] + 1
    sets = PredictionSet(density, level, "density")
    if concentration < 0.5:
        half, wanted = math.pi, TURN
    else:
        half = 2 * math.asin(math.sqrt(1 / (2 * concentration)))
        wanted = 2 * half
    # relative to an arc's size, or to the resolution of a float64 angle of 3
    np.testing.assert_allclose(sets.size().numpy(), wanted, rtol=1e-9, atol=1e-13)
    if half < math.pi:
        (low, high), *more = sets.intervals()[0]
        assert not more and -math.pi <= low < math.pi < 3.1 + half + 0.1
        assert (low, high) == pytest.approx((3.1 - half, 3.1 + half), abs=1e-12)
        beyond = hot([[3.1], [0.0], [-40.0]]) + half * torch.tensor([1.001]).double()
        inside = hot([[3.1], [0.0], [-40.0]]) - half * torch.tensor([0.999]).double()
        assert not sets.contains(beyond).any() and sets.contains(inside).all()


@pytest.mark.parametrize("concentration", CONCENTRATIONS)
def test_arcs_of_one_mass(concentration):
    sizes = PredictionSet(von_mises([0.0, 2.0], concentration), -hot(0.1).log(), "mass").size().numpy()
    if concentration < 1e8:
        wanted = 2 * stats.vonmises.ppf(0.95, concentration)
    else:  # the normal limit
        wanted = 2 * stats.norm.ppf(0.95) / concentration**0.5
    np.testing.assert_allclose(sizes, wanted, rtol=2e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("spread", [1e-6, 1e-2, 1.0, 1e6])
def test_intervals_of_reals(dtype, spread):
    density = normal([0.0, 0.5, -2.0], spread, dtype)
    drop = 2.0  # nats: log p falls by d²/2σ²
    level = -density.log_prob(density.mode)[0].double() + drop
    sets = PredictionSet(density, level, "density")
    half = math.sqrt(2 * drop) * spread
    digits = {torch.float32: 1e-6, torch.float64: 1e-11}[dtype]
    for place, parts in zip((0.0, 0.5, -2.0), sets.intervals(), strict=True):
        assert len(parts) == 1
        assert parts[0] == pytest.approx((place - half, place + half), abs=digits * (half + abs(place)))
    narrowest = PredictionSet(density, -hot(0.1).log(), "mass").size()[0].item()
    assert narrowest == pytest.approx(2 * stats.norm.ppf(0.95) * spread, rel=2e-3)
    assert PredictionSet(density, EVERYTHING, "mass").intervals() == [[(-math.inf, math.inf)]] * 3
    assert PredictionSet(density, EVERYTHING, "density").size().tolist() == [math.inf] * 3


@pytest.mark.parametrize(
    ("unit", "dtype"),
    [
        *((unit, torch.float32) for unit in (1e-15, 1e15)),
        *((unit, torch.float64) for unit in (1e-30, 1e-15, 1e15, 1e30)),
    ],
)
@pytest.mark.parametrize("score", ["density", "mass", "quantiles"])
def test_sets_do_not_depend_on_the_unit(score, unit, dtype):
    def intervals(unit):
        base = normal([0.0, 1.5], 1.0, dtype)
        density = AffineDensity(base, torch.zeros(2, 1, dtype=dtype), torch.full((2, 1), unit, dtype=dtype))
        thresholds = {"density": 2.5 + math.log(unit), "mass": -math.log(0.1), "quantiles": 0.3 * unit}
        sets = PredictionSet(density, hot(thresholds[score]), score, 0.9)
        middle = sets.contains(density.mode + hot([[[1.0]], [[30.0]]]).to(dtype) * unit)
        assert middle.tolist() == [[True, True], [False, False]]
        return np.array(sets.intervals()) / unit, sets.size().numpy() / unit

    for scaled, plain in zip(intervals(unit), intervals(1.0), strict=True):
        np.testing.assert_allclose(scaled, plain, rtol=1e-5, atol=1e-5)


def test_far_values_have_scores_that_differ():
    """Check an overconfident model, whose masses all round to 1 while their complements do not."""
    density = normal([0.0] * 4, 1.0)
    value = torch.tensor([[8.0], [20.0], [100.0], [1e6]]).double()
    scores = PredictionSet(density, EVERYTHING, "mass").scores(value)
    wanted = -(stats.norm.logsf(value[:, 0].numpy()) + math.log(2))
    np.testing.assert_allclose(scores.numpy(), wanted, rtol=2e-3)
    assert (scores.diff() > 0).all()


def two_humps(first, second, spreads, weights=(0.5, 0.5)):
    place = torch.tensor([[[first], [second]]]).double()
    spread = torch.tensor(spreads).double().reshape(1, 2, 1)
    return Mixture(
        torch.tensor([weights]).double().log(),
        Independent(Normal(place, spread, validate_args=False), 1, validate_args=False),
    )


@pytest.mark.parametrize("spreads", [(1e-6, 1e-6), (1e-6, 1.0), (1e-3, 1.0), (1.0, 1.0)])
def test_two_humps_are_two_intervals_however_narrow(spreads):
    density = two_humps(-3.0, 5.0, spreads, (0.5, 0.5))
    heights = density.log_prob(torch.tensor([[[-3.0]], [[5.0]]]).double())[:, 0]
    level = heights.min() - 0.5  # half a nat below the lower hump
    parts = PredictionSet(density, -level, "density").intervals()[0]
    assert len(parts) == 2

    def above(x):
        return density.log_prob(hot([[x]])).item() - level.item()

    for place, spread, (low, high) in zip((-3.0, 5.0), spreads, parts, strict=True):
        inner, outer = place, place + 0.49 * 8
        right = optimize.brentq(above, inner, outer, xtol=1e-15, rtol=1e-14)
        assert high == pytest.approx(right, abs=1e-9 * spread + 1e-15 * abs(place) * 4)
        assert low == pytest.approx(2 * place - right, abs=0.05 * spread)


def test_arcs_across_the_cut_and_several_of_them():
    kind = type(von_mises([0.0], 1.0))
    means = torch.tensor([[[3.1], [0.5], [-1.2]]]).double()
    density = Mixture(torch.zeros(1, 3), kind(means, torch.full((1, 3, 1), 200.0).double()))
    level = density.log_prob(density.mode) - 3
    sets = PredictionSet(density, -level[0], "density")
    parts = sets.intervals()[0]
    assert len(parts) == 3 and parts == sorted(parts)
    assert (
        sum(low < mean % TURN < high or low < mean < high for low, high in parts for mean in (3.1, 0.5, -1.2))
        == 3
    )
    assert parts[-1][1] > math.pi  # counter-clockwise across the cut
    angles, _ = circular_grid(density, 100_000)
    share = sets.contains(angles.reshape(-1, 1, 1)).double().mean().item()
    assert sets.size().item() == pytest.approx(TURN * share, abs=1e-4)
    # the complement of one arc: one arc
    wide = PredictionSet(Cardioid(torch.tensor([[0.3]]).double()), hot(4.0), "density")
    ((low, high),) = wide.intervals()[0]
    assert high - low == pytest.approx(wide.size().item()) and high - low > 5


def test_part_of_a_turn_has_ends():
    rotation = build_head("matrix_fisher", Target("angle", ("azimuth", "elevation", "tilt")))
    with torch.no_grad():
        elevation = marginal(rotation(torch.zeros(2, 9)), 1)
    whole = PredictionSet(elevation, EVERYTHING, "density")
    assert whole.intervals() == [[(-math.pi / 2, math.pi / 2)]] * 2
    # uniform rotations: p(e) = cos(e)/2, above cos(1)/2 within ±1
    level = math.log(math.cos(1.0) / 2)
    intervals = PredictionSet(elevation, -hot(level), "density").intervals()
    np.testing.assert_allclose(intervals, [[(-1.0, 1.0)]] * 2, atol=1e-6)
    mass = PredictionSet(elevation, -hot(0.1).log(), "mass").size().double().numpy()
    np.testing.assert_allclose(mass, 2 * math.asin(0.9), rtol=2e-3)


def test_volumes_of_several_numbers():
    torch.manual_seed(5)
    root = torch.tensor([[2.0, 0.0], [0.7, 0.5]]).double().expand(3, 2, 2)
    density = MultivariateNormal(torch.zeros(3, 2).double(), scale_tril=root, validate_args=False)
    area = 2 * math.pi * 1.0 * 1.5  # of the ellipse where log p has fallen by 1.5 nats, |Σ|^½ = 1
    sets = PredictionSet(density, -density.log_prob(density.mode)[0] + 1.5, "density")
    np.testing.assert_allclose(sets.size().numpy(), area, rtol=0.15)
    assert not sets.empty().any()
    nine = PredictionSet(density, -hot(0.1).log(), "mass")
    inside = nine.contains(density.sample((4000,))).double().mean(0)
    np.testing.assert_allclose(inside.numpy(), 0.9, atol=0.04)
    assert PredictionSet(density, EVERYTHING, "mass").size().tolist() == [math.inf] * 3
    turns = PredictionSet(Cardioid(torch.zeros(2, 2)), EVERYTHING, "density").size()
    np.testing.assert_allclose(turns.numpy(), TURN**2)
    # scores beyond every draw still differ
    far = torch.tensor([[30.0, 0.0], [60.0, 0.0], [90.0, 0.0]]).double()
    assert (nine.scores(far).diff() > 0).all()


@pytest.mark.parametrize("drop", [0.5, 3.0, 20.0, 200.0])
@pytest.mark.parametrize("count", [2, 3, 7])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_sets_of_a_normal_density_are_ellipsoids(count, drop, dtype):
    """Compare with the volume of a ball, by recursion, times |Σ|^½; some sets reach far beyond all samples."""
    root = torch.eye(count).tril() + 0.3 * torch.ones(count, count).tril(-1)
    root = (root * (1 + torch.arange(count)).reshape(-1, 1)).to(dtype).expand(3, count, count)
    density = MultivariateNormal(torch.ones(3, count, dtype=dtype), scale_tril=root, validate_args=False)
    sets = PredictionSet(density, drop - density.log_prob(density.mode)[0].double(), "density")
    ball = {0: 1.0, 1: 2.0}
    for n in range(2, count + 1):
        ball[n] = 2 * math.pi / n * ball[n - 2]
    volume = ball[count] * (2 * drop) ** (count / 2) * math.factorial(count)
    np.testing.assert_allclose(sets.size().numpy(), volume, rtol=1e-5 if dtype == torch.float32 else 1e-10)
    assert not sets.size_error().any()


@pytest.mark.parametrize("drop", [1.0, 6.0, 30.0])
@pytest.mark.parametrize("kind", ["reals", "angles"])
def test_other_volumes_have_an_error_that_covers_the_quadratures(kind, drop):
    """Check 40 estimates for mixtures and for two angles, up to sets far beyond all samples.

    All lie within 4.5 standard errors, and more than 30 % within one, up to the error of the quadrature.
    """
    torch.manual_seed(7)
    if kind == "reals":
        place = torch.tensor([[[0.0, 0.0], [3.0, 1.0]]]).double()
        density = Mixture(torch.zeros(1, 2), normals_apart(place))
        axes = [torch.linspace(-15, 15, 1201).double()] * 2
    else:
        kind_of = type(build_head("von_mises")(torch.zeros(1, 3)))
        density = kind_of(torch.zeros(1, 2).double(), torch.tensor([[5.0, 9.0]]).double())
        axes = [torch.linspace(-math.pi, math.pi, 1201).double()[:-1]] * 2
    threshold = drop - density.log_prob(density.mode)[0].double()
    grid = torch.cartesian_prod(*axes).unsqueeze(1)
    cell = math.prod(float(axis[1] - axis[0]) for axis in axes)
    wanted = cell * float((-density.log_prob(grid) <= threshold).double().sum())
    sets = [PredictionSet(density, threshold, "density") for _ in range(40)]
    size, error = (
        torch.cat(column) for column in zip(*((part.size(), part.size_error()) for part in sets), strict=True)
    )
    gap = (size - wanted).abs()
    assert (gap <= 4.5 * error + 0.01 * wanted).all() and error.max() < 0.15 * wanted
    if drop < 30 or kind == "reals":  # a set that is the whole torus has no sampling error
        assert float((gap < error + 0.003 * wanted).double().mean()) > 0.3


def normals_apart(place):
    return Independent(Normal(place, torch.ones_like(place), validate_args=False), 1, validate_args=False)


def test_shares_among_draws_by_a_loop():
    density = MultivariateNormal(torch.zeros(1, 2).double(), torch.eye(2).double(), validate_args=False)
    sets = PredictionSet(density, EVERYTHING, "mass")
    value = torch.tensor([[[0.5, 0.5]], [[1.0, 2.0]]]).double()
    scores = sets.scores(value)[:, 0]
    for log_prob, score in zip(density.log_prob(value)[:, 0].tolist(), scores.tolist(), strict=True):
        fewer = sum(sample < log_prob for sample in sets._log_draws[:, 0].tolist())
        low, high = -math.log((fewer + 2) / 1001), -math.log((fewer + 1) / 1001)
        assert low - 1e-9 <= score <= high + 1e-9


@pytest.mark.parametrize("score", ["density", "mass"])
@pytest.mark.parametrize("kind", DENSITIES)
def test_everything_empty_batches_and_nothing(kind, score):
    density = DENSITIES[kind]
    assert PredictionSet(density, EVERYTHING, score).contains(density.sample()).all()
    assert not PredictionSet(density, EVERYTHING, score).empty().any()
    nothing = PredictionSet(density, hot(-1e3), score)
    assert nothing.empty().all() and not nothing.size().any()
    none = {
        "classes": Categorical(logits=torch.zeros(0, 3), validate_args=False),
        "angle": Cardioid(torch.zeros(0, 1)),
        "mixture of angles": Mixture(torch.zeros(0, 2), Cardioid(torch.zeros(0, 2, 1))),
        "real": MultivariateNormal(torch.zeros(0, 1), torch.eye(1), validate_args=False),
        "reals": MultivariateNormal(torch.zeros(0, 2), torch.eye(2), validate_args=False),
    }[kind]
    sets = PredictionSet(none, hot(1.0), score)
    assert sets.size().shape == sets.empty().shape == sets.scores(none.sample()).shape == (0,)
    if kind in ("angle", "real"):
        assert sets.intervals() == []


def test_batches_of_any_shape_and_what_wrappers_make():
    first = Cardioid(torch.randn(4, 1).double())
    second = von_mises([0.0, 1.0, 2.0, 3.0], 40.0)
    mixture = Mixture(torch.zeros(4, 2), Stacked([first, second]))
    folded = PredictionSet(Reshaped(mixture, (2, 2)), hot(1.0), "mass")
    plain = PredictionSet(mixture, hot(1.0), "mass")
    torch.testing.assert_close(folded.size().reshape(4), plain.size())
    assert folded.intervals() == plain.intervals()


def test_nan_is_in_no_set():
    density = normal([math.nan, 0.0], 1.0)
    for score in ("density", "mass"):
        for threshold in (hot(1.0), EVERYTHING):
            sets = PredictionSet(density, threshold, score)
            assert sets.contains(torch.zeros(2, 1).double()).tolist() == [False, True]
            assert sets.size().isnan().tolist() == [True, False]
        assert sets.scores(torch.zeros(2, 1).double()).isnan().tolist() == [True, False]


def test_what_a_set_has_not_gets_a_sentence():
    with pytest.raises(UserError, match=r"labels\(\) exists only for sets of classes"):
        PredictionSet(DENSITIES["angle"], hot(1.0), "density").labels()
    for kind in ("classes", "reals"):
        with pytest.raises(UserError, match=r"intervals\(\) exists only for sets of one angle or one real"):
            PredictionSet(DENSITIES[kind], hot(1.0), "density").intervals()


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.floats(-3.2, 3.2), min_size=1, max_size=4),
    st.lists(st.floats(-3, 6), min_size=4, max_size=4),
    st.floats(0.05, 0.95),
    st.sampled_from(["density", "mass"]),
)
def test_sets_are_what_contains_says(means, exponents, mass, score):
    """Check that `contains` changes at the ends of arcs, and that a mass set has its probability."""
    kind = type(von_mises([0.0], 1.0))
    count = len(means)
    place = torch.tensor(means).double().reshape(1, count, 1)
    narrow = 10 ** torch.tensor(exponents[:count]).double().reshape(1, count, 1)
    density = Mixture(torch.zeros(1, count), kind(place, narrow))
    threshold = -hot(1 - mass).log()
    if score == "density":
        threshold = -density.log_prob(density.mode)[0] - math.log(mass)
    sets = PredictionSet(density, threshold, score)
    parts = sets.intervals()[0]
    assert sets.size().item() == pytest.approx(sum(high - low for low, high in parts))
    for low, high in parts:
        assert -math.pi <= low < math.pi and low < high <= low + TURN + 1e-9
        within = torch.linspace(low, high, 7).double()[1:-1].reshape(-1, 1, 1)
        assert sets.contains(within).all()
    gaps = [
        (high, low) for (_, high), (low, _) in zip(parts, [*parts[1:], (parts[0][0] + TURN, 0)], strict=True)
    ]
    for high, low in gaps if sets.size().item() < TURN - 1e-6 else []:
        assert low > high
        middle = torch.tensor([(low + high) / 2]).double().reshape(1, 1, 1)
        assert not sets.contains(middle).any() or low - high < 1e-9
    if score == "mass":
        torch.manual_seed(6)
        share = sets.contains(density.sample((4000,))).double().mean().item()
        assert share == pytest.approx(mass, abs=0.04)


def test_levels_and_scores_are_inverse():
    line = Line(two_humps(-1.0, 2.0, (0.1, 1.0)))
    for score in (1e-6, 0.1, 2.3, 50.0, 5000.0):
        level = line.level_of(hot(score))
        assert line.score_of(level).item() == pytest.approx(score, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("closed", [False, True], ids=["real", "angle"])
@pytest.mark.parametrize("humps", [2, 5])
@pytest.mark.parametrize("count", [7, 65, 500])
def test_no_hump_is_lost_among_many_components(closed, humps, count):
    """Check mixtures of one hump of 60 % and smaller ones, each of many components, in any number and order."""
    torch.manual_seed(count)
    hump = torch.where(torch.rand(ITEMS, count) < 0.6, 0, torch.randint(1, humps, (ITEMS, count)))
    hump[:, :humps] = torch.arange(humps)  # each has one at least
    place = (hump * 1.2 - 3 + 0.006 * torch.randn(ITEMS, count)).double().unsqueeze(-1)
    if closed:
        component = type(build_head("von_mises")(torch.zeros(1, 3)))(place, torch.full_like(place, 2500.0))
    else:
        component = Independent(Normal(place, torch.full_like(place, 0.02), validate_args=False), 1)
    density = Mixture(torch.zeros(ITEMS, count, dtype=torch.float64), component)
    level = -math.log(1e-4)
    sets = PredictionSet(density, hot(level), "density")
    assert [len(parts) for parts in sets.intervals()] == [humps] * ITEMS
    grid = torch.linspace(-3.1, 2.2, 5001, dtype=torch.float64)
    inside = density.log_prob(grid.reshape(-1, 1, 1).expand(-1, ITEMS, 1)) >= -level
    wanted = inside.double().mean(0) * (grid[-1] - grid[0])
    torch.testing.assert_close(sets.size(), wanted, rtol=0, atol=1e-2 * humps)


@pytest.mark.parametrize("name", ["scvae", "cvae"])
def test_a_latent_density_shows_its_components_humps(name):
    head = build(
        "density_head",
        resolve("density_head", {"name": name, "samples": 200}),
        target=Target("angle", ("pan",)),
    ).eval()
    torch.manual_seed(3)
    density = head(3 * torch.randn(6, head.size))
    mixture = density if isinstance(density, Mixture) else density.mixture
    torch.testing.assert_close(mode_candidates(density), mode_candidates(mixture))
    torch.testing.assert_close(peak_widths(density), peak_widths(mixture))
