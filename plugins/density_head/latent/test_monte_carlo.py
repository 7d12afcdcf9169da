import math

import mpmath
import numpy as np
import pytest
import torch
from torch.distributions import Independent, Normal

from framework.distributions.closed_forms import normal_quantile
from framework.distributions.protocol import estimate
from framework.errors import ConfigError
from plugins.density_head.latent import monte_carlo
from plugins.density_head.latent.monte_carlo import (
    Effort,
    NormalPoints,
    SampledMixture,
    estimate_from_sums,
    estimate_log_mean,
    estimated_error,
    lattice,
    rows_of,
    stretch,
)

CPU = torch.device("cpu")
ITEMS = 60
FALL = torch.linspace(0.5, 40, ITEMS, dtype=torch.float64)  # how narrow the weights are
TRUTH = -FALL * 0.16 / (2 * (1 + FALL)) - torch.log1p(FALL) / 2  # log E w, by completing the square


def bump(z, items):
    """Return log w(z) = -a (t - 0.4)²/2, where t ~ N(0, 1) is z's component along (1, 1, …) and a differs by item."""
    return -FALL[items] * (z.sum(-1) / z.shape[-1] ** 0.5 - 0.4).square() / 2


def run_estimate(effort, dimensions=2, seed=0, at_once=2**20, log_weight=bump):
    """Return the estimate that a density computes: with a tolerance, from points with heavier tails."""
    torch.manual_seed(seed)
    points = NormalPoints(ITEMS, effort.replicates, dimensions, dtype=torch.float64, device=CPU)

    def log_weights(items, start, count):
        z = points(items, start, count)
        if effort.tolerance is None:
            return log_weight(z, items)
        z, log_share = stretch(z)
        return torch.stack([log_weight(z, items) + log_share, log_share])

    with torch.no_grad():
        return estimate_log_mean(log_weights, ITEMS, effort, at_once=at_once, device=CPU)


def test_the_lattice_mirrors_digits_and_continues():
    points = lattice(0, 40, 3)
    for number in range(40):
        inverse = int(format(number, "032b")[::-1], 2) / 2**32
        expected = [math.fmod(inverse * pow(1267, power, 2**20), 1.0) for power in range(3)]
        assert points[number].tolist() == expected
    assert torch.equal(lattice(13, 27, 3), points[13:])
    far = lattice(2**30, 4, 8)
    assert ((far >= 0) & (far < 1)).all()
    assert len(far.unique(dim=0)) == 4


@pytest.mark.parametrize("power", [3, 6, 9])
def test_powers_of_two_fill_every_cell_of_a_line_once(power):
    places = lattice(0, 2**power, 5)
    for dimension in range(5):
        assert (places[:, dimension] * 2**power).sort().values.tolist() == list(range(2**power))


def test_the_quantile_agrees_with_40_digits_and_is_never_infinite():
    places = [2.0**-50, 1e-12, 1e-5, 0.02425, 0.3, 0.5, 0.8, 1 - 1e-9, 1 - 2.0**-53]
    quantiles = normal_quantile(torch.tensor(places, dtype=torch.float64))
    with mpmath.workdps(40):
        for z, place in zip(quantiles.tolist(), places, strict=True):
            # compared through Φ, relative to the smaller tail: rounding of a position near 1 is not an error of z
            tail, back = (
                (mpmath.mpf(place), mpmath.ncdf(z))
                if place <= 0.5
                else (1 - mpmath.mpf(place), mpmath.ncdf(-mpmath.mpf(z)))
            )
            assert abs(back / tail - 1) < 1e-13 * max(1, z * z)
    for dtype in (torch.float32, torch.float64):
        ends = normal_quantile(torch.tensor([0.0, 1.0], dtype=dtype))
        assert ends.dtype == dtype and ends.abs().tolist() == pytest.approx([8.3, 8.2], abs=0.1)


def test_points_are_normal_apart_and_the_same_in_both_precisions():
    torch.manual_seed(3)
    points = NormalPoints(500, 4, 2, dtype=torch.float64, device=CPU)
    items = torch.arange(500)
    z = points(items, 0, 64)
    assert z.shape == (4, 64, 500, 2)
    assert z.mean().abs() < 0.01
    assert z.square().mean() == pytest.approx(1, abs=0.02)
    # the means of replicates and items do not vary together
    means = z.square().mean(1)[..., 0]
    assert abs(np.corrcoef(means.numpy())[0, 1:]).max() < 4 / 500**0.5
    torch.manual_seed(3)
    single = NormalPoints(500, 4, 2, dtype=torch.float32, device=CPU, kept_count=40)
    some = torch.tensor([7, 7, 0])
    for start, count in ((0, 40), (10, 7), (30, 34)):  # kept and recomputed
        assert torch.equal(single(some, start, count), z[:, start : start + count, some].float())


def test_replicates_divide_the_samples():
    for samples, replicates, first in (
        (1, 1, 1),
        (2, 2, 1),
        (11, 1, 11),
        (50, 5, 10),
        (500, 5, 100),
        (1000, 8, 125),
    ):
        assert (Effort(samples).replicates, Effort(samples).first) == (replicates, first)
    for samples, first in ((1, 8), (64, 8), (256, 8), (257, 16), (500, 16), (1000, 32)):
        assert (Effort(samples, 0.1).replicates, Effort(samples, 0.1).first) == (32, first)


@pytest.mark.parametrize(
    "samples, tolerance", [(0, None), (10, 0.0), (10, -1.0), (10, math.nan), (10, math.inf)]
)
def test_an_effort_that_makes_no_sense_is_refused(samples, tolerance):
    with pytest.raises(ConfigError, match="expected"):
        Effort(samples, tolerance)


def test_an_estimate_of_given_sums():
    weights = np.array([[1.0, 5.0], [2.0, 5.0], [6.0, 5.0]])  # (replicate, item), sums of 4
    result = estimate_from_sums(torch.from_numpy(np.log(weights)), 4)
    np.testing.assert_allclose(result.log_mean, np.log(weights.mean(0) / 4), rtol=1e-14)
    error = weights.std(0, ddof=1) / 3**0.5 / weights.mean(0)
    np.testing.assert_allclose(result.standard_error, error, rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(result.debiased - result.log_mean, error**2 / 2, rtol=1e-13, atol=1e-15)
    assert result.samples.tolist() == [12, 12]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_estimates_from_sums_of_very_different_size_do_not_overflow(dtype):
    inf = math.inf
    sums = torch.tensor([[-1e4, 1e4, -inf, -1e4, -1e30], [-1e4 + 1, 1e4, -inf, 1e4, -inf]], dtype=dtype)
    result = estimate_from_sums(sums, 1)
    assert result.log_mean.tolist()[2] == result.debiased.tolist()[2] == -inf
    # weights 1 and e: the ratio of their half difference to their mean
    assert result.standard_error.tolist() == pytest.approx([math.tanh(0.5), 0, inf, 1, 1], rel=1e-3)
    assert result.log_mean[[0, 1, 3]].tolist() == pytest.approx(
        [-1e4 + math.log((1 + math.e) / 2), 1e4, 1e4 - math.log(2)], rel=1e-6
    )
    assert (result.debiased - result.log_mean)[[0, 1, 3, 4]].max() <= 0.5 + 1e-2
    one_replicate = estimate_from_sums(sums[:1], 1)
    assert one_replicate.standard_error[:2].isnan().all()
    assert torch.equal(one_replicate.log_mean, sums[0])


@pytest.mark.parametrize("shift", [-1e4, 1e4])
@pytest.mark.parametrize("effort", [Effort(64), Effort(64, 0.01)])
def test_a_factor_of_all_weights_changes_nothing_else(shift, effort):
    plain = run_estimate(effort)
    moved = run_estimate(effort, log_weight=lambda z, items: bump(z, items) + shift)
    torch.testing.assert_close(moved.log_mean - shift, plain.log_mean, rtol=0, atol=1e-10)
    torch.testing.assert_close(moved.standard_error, plain.standard_error, rtol=1e-6, atol=1e-10)
    assert torch.equal(moved.samples, plain.samples)


def test_chunks_change_nothing():
    for effort in (Effort(60), Effort(64, 0.02)):
        whole, chunked = run_estimate(effort), run_estimate(effort, at_once=50)
        torch.testing.assert_close(chunked.log_mean, whole.log_mean, rtol=1e-12, atol=1e-12)
        assert torch.equal(chunked.samples, whole.samples)


def test_no_more_is_asked_for_at_once_than_allowed():
    sizes = []

    def log_weight(z, items):
        sizes.append(z[..., 0].numel())
        return bump(z, items)

    run_estimate(Effort(64, 0.01), at_once=200, log_weight=log_weight)
    assert max(sizes) <= 200
    assert sum(sizes) > 20 * 200


def test_the_estimate_is_the_mean_over_the_points():
    torch.manual_seed(0)
    points = NormalPoints(ITEMS, 5, 2, dtype=torch.float64, device=CPU)
    weights = bump(points(torch.arange(ITEMS), 0, 10), torch.arange(ITEMS)).exp()
    torch.testing.assert_close(run_estimate(Effort(50)).log_mean, weights.mean((0, 1)).log())


@pytest.mark.parametrize("samples", [64, 500])
def test_the_standard_error_is_that_of_many_seeds(samples):
    estimates = [run_estimate(Effort(samples), seed=seed) for seed in range(200)]
    errors = torch.stack([result.log_mean for result in estimates]) - TRUTH
    standard_errors = torch.stack([result.standard_error for result in estimates])
    ratio = errors.square().mean(0).sqrt() / standard_errors.square().mean(0).sqrt()
    assert ratio.median() == pytest.approx(1, abs=0.1)
    assert ratio.min() > 0.7
    assert ratio.max() < 1.5
    # five or eight replicates: Student's t with 4 or 7 degrees of freedom has 88 % to 92 % within 2
    within = (
        ((torch.stack([result.debiased for result in estimates]) - TRUTH).abs() < 2 * standard_errors)
        .double()
        .mean()
    )
    assert 0.83 < within < 0.96


def test_debiasing_takes_most_of_the_bias():
    estimates = [run_estimate(Effort(32), seed=seed) for seed in range(1000)]
    bias = (torch.stack([result.log_mean for result in estimates]) - TRUTH).mean(0)
    debiased = (torch.stack([result.debiased for result in estimates]) - TRUTH).mean(0)
    assert bias.mean() < -0.05
    assert debiased.mean().abs() < bias.mean().abs() / 2, (bias.mean(), debiased.mean())


@pytest.mark.parametrize("dimensions, factor", [(1, 30), (2, 5)])
def test_lattice_points_are_better_than_independent_ones(dimensions, factor):
    def by_chance(seed):
        torch.manual_seed(seed)
        weights = bump(torch.randn(512, ITEMS, 1, dtype=torch.float64), torch.arange(ITEMS))
        return torch.logsumexp(weights, 0) - math.log(512)

    independent = torch.stack([by_chance(seed) for seed in range(40)]) - TRUTH
    ours = torch.stack([run_estimate(Effort(512), dimensions, seed).log_mean for seed in range(40)]) - TRUTH
    assert ours.square().mean() < independent.square().mean() / factor


@pytest.mark.parametrize("tolerance", [0.1, 0.01, 0.001])
def test_the_tolerance_is_reached(tolerance):
    estimates = [run_estimate(Effort(64, tolerance), seed=seed) for seed in range(30)]
    error = (torch.stack([result.log_mean for result in estimates]) - TRUTH).abs()
    assert not any(result.unresolved.any() for result in estimates)
    assert all((estimated_error(result) <= tolerance).all() for result in estimates)
    # the estimated error is a standard error, with eight replicates' uncertainty: 75 % within one, 99 % within three
    assert (error < tolerance).double().mean() > 0.75
    assert (error < 3 * tolerance).double().mean() > 0.97
    samples = torch.stack([result.samples for result in estimates])
    assert samples.min() >= 64
    assert (samples & (samples - 1) == 0).all()  # doubled
    assert samples[:, -1].double().mean() > samples[:, 0].double().mean()  # narrow weights need more samples


@pytest.mark.parametrize("dimensions, highest", [(1, 25.0), (2, 25.0), (4, 9.0)])
def test_shares_have_the_mean_1_and_points_come_far_out(dimensions, highest):
    points = NormalPoints(1, 1, dimensions, dtype=torch.float64, device=CPU)
    z, log_share = stretch(points(torch.zeros(1, dtype=torch.int64), 0, 2**16))
    share = log_share.exp()[0, :, 0]
    assert share.mean().item() == pytest.approx(1, abs=0.01)
    assert (share * z[0, :, 0, 0].square()).mean().item() == pytest.approx(1, abs=0.02)
    assert z.square().amax() > highest


@pytest.mark.parametrize("dimensions", [1, 2])
@pytest.mark.parametrize("tolerance", [0.1, 0.01])
def test_the_estimated_error_is_the_error_however_samples_were_chosen(dimensions, tolerance):
    """Compare estimated and actual errors of weights like those of a decoder, and of a far too narrow proposal.

    The root mean square is within 15 % of the estimated one, and about 1 % lie beyond three standard errors.
    """

    def narrow_proposal(z, items):
        # posterior of variance 1, proposed with 1/2 … 1/7: exp(z²/2 (1 - s²)) s^d, with mean 1
        s = (1 / (1 + FALL / 8))[items].sqrt()
        return (z.square().sum(-1) * (1 - s.square()) / 2) + dimensions * s.log()

    for log_weight, truth in ((bump, TRUTH), (narrow_proposal, torch.zeros(ITEMS, dtype=torch.float64))):
        estimates = [
            run_estimate(Effort(64, tolerance), dimensions, seed, log_weight=log_weight) for seed in range(30)
        ]
        error = torch.stack([result.log_mean for result in estimates]) - truth
        standard_errors = torch.stack([result.standard_error for result in estimates])
        resolved = ~torch.stack([result.unresolved for result in estimates])
        assert resolved.all()
        assert error.square().mean().sqrt() / standard_errors.square().mean().sqrt() == pytest.approx(
            1, abs=0.15
        )
        assert (error.abs() > 3 * standard_errors).double().mean() < 0.02


@pytest.mark.parametrize("height", [5.0, 20.0, 60.0])
@pytest.mark.parametrize("border", [3.0, 4.0, 5.0])
def test_a_rare_event_is_sampled_or_reported(height, border):
    """Check weights of 1 up to a border and e^height above, whose mean has the log log(1 + P (e^height - 1)).

    The estimate is right to four standard errors and a fifth of the tolerance, or it is reported as unresolved.
    """
    rare = math.log1p(float(mpmath.ncdf(-border)) * math.expm1(height))
    honest = []
    for seed in range(5):
        result = run_estimate(
            Effort(500, 0.05),
            1,
            seed,
            log_weight=lambda z, items: torch.where(z[..., 0] > border, height, 0.0),
        )
        error = (result.log_mean - rare).abs()
        honest.append(result.unresolved | (error < 4 * result.standard_error + 0.01))
    assert torch.stack(honest).double().mean() > 0.97


def test_what_cannot_be_resolved_is_given_up_and_reported(monkeypatch):
    monkeypatch.setattr(monte_carlo, "MOST", 1000)

    def log_weight(z, items):
        weights = bump(z, items)
        weights = torch.where(items == 3, -math.inf, weights)
        return torch.where(items == 5, math.nan, weights)

    result = run_estimate(Effort(64, 1e-12), log_weight=log_weight)
    assert result.samples.max() == 512
    assert result.unresolved.all()
    assert result.log_mean[3] == -math.inf
    assert result.log_mean[5].isnan()
    assert result.samples[5] == 256  # more samples cannot help
    good = torch.tensor([item for item in range(ITEMS) if item not in (3, 5)])
    torch.testing.assert_close(result.log_mean[good], TRUTH[good], rtol=0, atol=0.2)


def test_an_estimate_is_differentiable():
    torch.manual_seed(0)
    points = NormalPoints(3, 8, 1, dtype=torch.float64, device=CPU)
    center = torch.tensor([0.1, 0.4, -0.5], dtype=torch.float64, requires_grad=True)

    def log_mean(center, effort):
        def log_weights(items, start, count):
            return -3 * (points(items, start, count)[..., 0] - center[items]).square()

        return estimate_log_mean(log_weights, 3, effort, at_once=16, device=CPU).log_mean

    for effort in (Effort(40), Effort(40, 0.05)):
        assert torch.autograd.gradcheck(lambda center, effort=effort: log_mean(center, effort), center)


def test_nothing_is_estimated_of_no_items():
    for effort in (Effort(10), Effort(10, 0.1)):

        def nothing(items, start, count, replicates=effort.replicates):
            return torch.zeros(replicates, count, len(items))

        result = estimate_log_mean(nothing, 0, effort, at_once=10, device=CPU)
        assert result.log_mean.shape == result.samples.shape == (0,)


def test_a_sampled_mixture_tells_its_error():
    torch.manual_seed(0)
    components = Independent(Normal(torch.randn(3, 40, 1), torch.ones(3, 40, 1)), 1)
    density = SampledMixture(torch.zeros(3, 40), components, 8)
    value = torch.randn(7, 3, 1)
    result = estimate(density, value)
    torch.testing.assert_close(result.log_mean, density.log_prob(value))
    weights = components.log_prob(value[:, :, None]).exp().reshape(7, 3, 8, 5).mean(-1)
    torch.testing.assert_close(result.standard_error, weights.std(-1) / 8**0.5 / weights.mean(-1))
    with torch.no_grad():  # in parts
        many = torch.randn(2**20 // 120 + 5, 3, 1)
        torch.testing.assert_close(estimate(density, many).log_mean, density.log_prob(many))


def test_every_value_is_paired_with_its_item_of_the_batch():
    value = torch.arange(24.0).reshape(4, 2, 3, 1)
    values, items, shape = rows_of(value, torch.Size((2, 3)), torch.Size((1,)))
    assert values.flatten().tolist() == list(range(24))
    assert items.tolist() == list(range(6)) * 4
    assert shape == (4, 2, 3)
    values, items, shape = rows_of(torch.tensor([2, 0]), torch.Size((3, 2)), torch.Size(()))
    assert values.tolist() == [2, 0] * 3
    assert items.tolist() == list(range(6))
    assert shape == (3, 2)
