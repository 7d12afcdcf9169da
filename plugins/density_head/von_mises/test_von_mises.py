import math
import subprocess
import sys
from contextlib import contextmanager
from functools import cache

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize, stats
from torch.distributions import kl_divergence

from framework.configuration.schema import build, resolve
from framework.distributions.protocol import arc_probability, marginal, median, pick
from framework.errors import ConfigError
from framework.target import Target
from framework.testing.head_subject import values
from plugins.density_head.von_mises import blocks, fit_coefficients, functions, integrals, processor
from plugins.density_head.von_mises.bessel import log_height, polynomial
from plugins.density_head.von_mises.coefficients import NODES, TABLES
from plugins.density_head.von_mises.density import LARGEST, VonMises
from plugins.density_head.von_mises.head import LEAST_SCALE, scale_of_raw

mpmath.mp.dps = 90
DTYPES = (torch.float32, torch.float64)
CONCENTRATIONS = (
    0,
    1e-30,
    1e-8,
    1e-4,
    1e-2,
    0.1,
    1,
    3.75,
    10,
    14,
    50,
    100,
    500,
    1e3,
    1e4,
    1e6,
    1e8,
    1e12,
    1e30,
)
OFFSETS = (0.0, 1e-8, 1e-4, 0.1, 1.0, math.pi / 2, 3.0, math.pi, 2 * math.pi - 1e-6, -2 * math.pi, 1e6, -1e6)
LIMIT = 8  # units of machine epsilon; the requirement is 16


@cache
def bessel(concentration):
    """Return log(I0(κ) exp(-κ)), A(κ), 1 - A(κ), A'(κ)."""
    kappa = mpmath.mpf(concentration)
    zero, first = mpmath.besseli(0, kappa), mpmath.besseli(1, kappa)
    ratio = first / zero
    slope = 1 - ratio**2 - ratio / kappa if kappa else mpmath.mpf(1) / 2
    return mpmath.log(zero) - kappa, ratio, 1 - ratio, slope


def leaf(number, dtype):
    return torch.tensor(number, dtype=dtype, requires_grad=True)


def error(computed, reference, scale, dtype):
    """Return the error |computed - reference| / scale, in machine epsilons."""
    return float(abs(mpmath.mpf(computed.item()) - reference) / scale) / torch.finfo(dtype).eps


def check_points(value, mean, concentration, log_prob, slopes):
    """Compare log_prob and its three gradients with a 90-digit reference."""
    dtype = value.dtype
    columns = (value, mean, concentration, log_prob, *slopes)
    for row in zip(*(column.detach().reshape(-1) for column in columns), strict=True):
        at, centre, concentrated, log_p, by_value, by_mean, by_concentration = row
        kappa = mpmath.mpf(concentrated.item())
        scaled, _, complement, _ = bessel(concentrated.item())
        difference = mpmath.mpf(at.item()) - mpmath.mpf(centre.item())
        fall = 2 * mpmath.sin(difference / 2) ** 2
        height = -mpmath.log(2 * mpmath.pi) - scaled
        # log p is the difference of two terms, dlogp/dκ of two others: errors are relative to the terms
        assert error(log_p, height - kappa * fall, max(1, abs(height), kappa * fall), dtype) < LIMIT, row
        assert error(by_concentration, complement - fall, complement + fall, dtype) < LIMIT, row
        turning = -kappa * mpmath.sin(difference)
        # the last term: a difference that is nearly a multiple of π loses only eps²
        scale = abs(turning) + kappa * torch.finfo(dtype).eps + torch.finfo(dtype).tiny
        assert error(by_value, turning, scale, dtype) < LIMIT, row
        assert by_mean == -by_value


@contextmanager
def way(fewest):
    """Compute tensors of at least `fewest` elements by compiled code (numba), and others by torch operations."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(processor, "FEWEST", fewest)
        patch.setattr(processor, "FEWEST_ONCE", fewest)
        yield


WAYS = {"compiled": 0, "torch": math.inf}
both_ways = pytest.mark.parametrize("fewest", list(WAYS.values()), ids=list(WAYS))


def check_point(value, mean, concentration):
    for fewest in WAYS.values():
        with way(fewest):
            log_prob = functions.log_prob(value, mean, concentration)
            slopes = torch.autograd.grad(log_prob, (value, mean, concentration))
            check_points(value, mean, concentration, log_prob, slopes)
            assert abs(
                functions.log_prob(*(x.detach() for x in (value, mean, concentration))) - log_prob
            ) <= (4 * torch.finfo(value.dtype).eps * max(1, concentration.item(), abs(log_prob.item())))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("mean", [0.0, 3.0, -1000.7])
def test_log_prob_and_gradients_agree_with_90_digits(dtype, mean):
    for concentration in CONCENTRATIONS:
        for offset in OFFSETS:
            check_point(leaf(mean + offset, dtype), leaf(mean, dtype), leaf(concentration, dtype))


angles = st.floats(-1e6, 1e6, width=32)


@settings(deadline=None, max_examples=150)
@given(angles, angles, st.one_of(st.just(0.0), st.floats(-30, 30).map(lambda power: 10.0**power)))
def test_log_prob_and_gradients_anywhere(value, mean, concentration):
    for dtype in DTYPES:
        check_point(leaf(value, dtype), leaf(mean, dtype), leaf(concentration, dtype))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("concentration", CONCENTRATIONS)
def test_functions_of_the_concentration_agree_with_90_digits(concentration, dtype):
    kappa = leaf(concentration, dtype)
    exact = mpmath.mpf(kappa.item())
    scaled, ratio, complement, slope = bessel(kappa.item())
    tiny = mpmath.mpf(torch.finfo(dtype).tiny)
    height = -mpmath.log(2 * mpmath.pi) - scaled
    entropy = exact * complement - height
    for computed, reference, scale in (
        (log_height(kappa), height, max(1, abs(height))),
        (functions.entropy(kappa), entropy, max(1, abs(entropy))),
        (functions.mean_resultant(kappa), ratio, ratio + tiny),
        (functions.mean_deviation(kappa), complement, complement),
        (functions.mean_resultant_slope(kappa), slope, slope + tiny),
    ):
        assert error(computed, reference, scale, dtype) < LIMIT
    for function, reference in (
        (functions.entropy, -exact * slope),
        (functions.mean_resultant, slope),
        (functions.mean_deviation, -slope),
    ):
        (computed,) = torch.autograd.grad(function(kappa), kappa)
        assert error(computed, reference, abs(reference) + tiny, dtype) < LIMIT


@pytest.mark.parametrize("dtype", DTYPES)
def test_no_seam_between_two_pieces(dtype):
    """Check that value and derivatives change by no more than rounding across each border, 40 floats to either side."""
    pieces = fit_coefficients.PIECES[str(dtype).removeprefix("torch.")]
    eps = torch.finfo(dtype).eps
    edges = torch.tensor([[2 * pieces / i - 2] for i in range(1, pieces)], dtype=torch.float64)
    near = (edges * (1 + eps * torch.arange(-40, 41))).to(dtype)
    for name in fit_coefficients.NAMES:
        values_near_edges = polynomial(name, 2 / (near + 2))
        assert (values_near_edges.diff().abs() <= 4 * eps * values_near_edges[:, 1:].abs()).all()
    for function, size in (
        (log_height, log_height(near).abs().clamp(min=1)),
        (functions.mean_deviation, functions.mean_deviation(near)),
        (functions.mean_resultant_slope, functions.mean_resultant_slope(near)),
        (functions.mean_resultant, functions.mean_resultant(near)),
    ):
        assert (function(near).diff().abs() <= 10 * eps * size[:, 1:]).all()


def test_entropy_agrees_with_scipy():
    kappa = torch.logspace(-4, 3, 50, dtype=torch.float64)
    np.testing.assert_allclose(functions.entropy(kappa), stats.vonmises.entropy(kappa.numpy()), rtol=1e-11)


@pytest.mark.parametrize("which, name", list(enumerate(fit_coefficients.NAMES)))
def test_the_coefficients_are_those_the_script_writes(which, name):
    assert np.array_equal(fit_coefficients.table("float32", which), TABLES["float32"][name])
    assert all(tuple(fit_coefficients.gauss_legendre(count)) == pairs for count, pairs in NODES.items())


@both_ways
@pytest.mark.parametrize("concentration", [0.0, 1e-6, 0.5, 3.75, 20.0, 1e3])
def test_first_and_second_derivatives_agree_with_finite_differences(concentration, fewest):
    arguments = [
        torch.tensor(numbers, dtype=torch.float64, requires_grad=True)
        for numbers in ([[0.3], [-2.0]], [0.1, 3.0], [concentration] * 2)
    ]
    with way(fewest):
        assert torch.autograd.gradcheck(functions.log_prob, arguments)
        assert torch.autograd.gradgradcheck(functions.log_prob, arguments)
    for function in (functions.entropy, functions.mean_resultant, functions.mean_deviation):
        assert torch.autograd.gradcheck(function, arguments[2:])
        assert torch.autograd.gradgradcheck(function, arguments[2:])


def test_gradients_reduce_over_broadcast_arguments():
    value, mean, kappa = torch.randn(5, 1, 3), torch.zeros(4, 1, requires_grad=True), leaf(2.0, torch.float32)
    functions.log_prob(value, mean, kappa).sum().backward()
    spread = [tensor.detach().expand(5, 4, 3).clone().requires_grad_() for tensor in (mean, kappa)]
    functions.log_prob(value, *spread).sum().backward()
    torch.testing.assert_close(mean.grad, spread[0].grad.sum((0, 2))[:, None])
    torch.testing.assert_close(kappa.grad, spread[1].grad.sum())


def log_prob_and_gradients(*arguments):
    log_prob = functions.log_prob(*arguments)
    leaves = [argument for argument in arguments if argument.requires_grad]
    return [log_prob.detach(), *torch.autograd.grad(log_prob.sum(), leaves)]


@pytest.mark.parametrize("dtype", DTYPES)
def test_compiled_code_and_torch_operations_agree(dtype):
    """Compare all concentrations and differences, also NaN and infinite ones, in one tensor that both ways compute."""
    columns = [(3.0 + off, 3.0, kappa) for off in OFFSETS for kappa in CONCENTRATIONS]
    unusual = [
        (math.nan, 0, 1),
        (1, math.nan, 1),
        (1, 0, math.nan),
        (math.inf, 0, 1),
        (1e30, 0, 2),
        (1, 0, math.inf),
    ]
    for rows in (columns, unusual):
        results = []
        for fewest in WAYS.values():
            with way(fewest):
                results.append(
                    log_prob_and_gradients(*(leaf(column, dtype) for column in zip(*rows, strict=True)))
                )
        value, mean, kappa = (
            torch.tensor(column, dtype=dtype).double() for column in zip(*rows, strict=True)
        )
        # log p and its derivative by κ are differences of two terms; rounding is relative to the terms
        fall, eps = 2 * torch.sin((value - mean) / 2) ** 2, torch.finfo(dtype).eps
        turning = kappa * (torch.sin(value - mean).abs() + eps)
        scales = 1 + kappa * fall, turning, turning, fall + functions.mean_deviation(kappa)
        for compiled, reference, scale in zip(*results, scales, strict=True):
            assert torch.equal(compiled.isnan(), reference.isnan())
            same = (compiled == reference) | reference.isnan()
            limit = 6 * eps * torch.maximum(reference.abs().double(), scale) + torch.finfo(dtype).tiny
            assert (same | ((compiled - reference).abs() <= limit)).all()


@both_ways
def test_every_layout_gives_the_same_numbers(fewest):
    """Strides, expanded and empty tensors, broadcasting and half precision change at most rounding."""
    wide = torch.rand(6, 7, 3)
    value, mean, kappa = wide.movedim(-1, 0)  # strides of 3 numbers
    for arguments in (
        (value, mean, kappa),
        (value.T, mean.T, kappa.T),
        (value[:, :1], mean[:1].expand(6, 7), kappa[0, 0]),
        (value[::2, ::3], mean[::2, 0, None], kappa[0, ::3].expand(3, 3)),
        (value[:0], mean[:0], kappa[:0]),
    ):
        arguments = [argument.detach().requires_grad_() for argument in arguments]
        with way(fewest):
            results = log_prob_and_gradients(*arguments)
        plain = [argument.detach().double().contiguous().requires_grad_() for argument in arguments]
        with way(math.inf):
            reference = log_prob_and_gradients(*plain)
        for result, wanted in zip(results, reference, strict=True):
            torch.testing.assert_close(result, wanted.float())
    for dtype in (torch.float16, torch.bfloat16):
        with way(fewest):
            half = [argument.to(dtype) for argument in (value, mean, kappa)]
            log_prob = VonMises(half[1], half[2]).log_prob(half[0])
            assert log_prob.dtype == dtype
            exact = functions.log_prob(*(argument.float() for argument in half)).sum(-1)
        torch.testing.assert_close(log_prob.float(), exact, rtol=2e-2, atol=2e-2)


@both_ways
def test_transforms_of_torch_func_see_the_same_density(fewest):
    value, mean, kappa = torch.randn(3, 40, dtype=torch.float64)
    kappa = kappa.exp()

    def density(value, mean, kappa):
        return VonMises(mean[None], kappa[None]).log_prob(value[None])

    with way(fewest):
        mapped = torch.func.vmap(density)(value, mean, kappa)
        slopes = torch.func.vmap(torch.func.grad(density, (0, 1, 2)))(value, mean, kappa)
        curvature = torch.func.vmap(torch.func.grad(torch.func.grad(density, 2), 2))(value, mean, kappa)
        leaves = [argument.clone().requires_grad_() for argument in (value, mean, kappa)]
        log_prob = functions.log_prob(*leaves)
        gradients = torch.autograd.grad(log_prob.sum(), leaves)
    torch.testing.assert_close(mapped, log_prob.detach())
    for slope, gradient in zip(slopes, gradients, strict=True):
        torch.testing.assert_close(slope, gradient)
    torch.testing.assert_close(curvature, -functions.mean_resultant_slope(kappa))


@pytest.mark.parametrize("dtype", DTYPES)
def test_blocks_change_nothing(dtype):
    """Compare one tensor in blocks, the same tensor in one pass, and its parts."""
    count = blocks.BLOCK * 2 + 5
    value, mean, kappa = torch.randn(count, dtype=dtype), torch.randn(count, dtype=dtype), torch.rand(count)
    arguments = [value, mean.requires_grad_(), kappa.to(dtype).requires_grad_()]
    tolerance = {"rtol": 16 * torch.finfo(dtype).eps, "atol": 4 * torch.finfo(dtype).eps}
    with way(math.inf):
        whole, *gradients = log_prob_and_gradients(*arguments)
        for part in torch.arange(count).split(1000):
            few = functions.log_prob(*(argument[part] for argument in arguments))
            torch.testing.assert_close(whole[part], few.detach(), **tolerance)
        in_one_pass = functions.log_prob(value[:, None], mean[:, None], kappa[:, None].to(dtype))
    torch.testing.assert_close(whole, in_one_pass[:, 0].detach())
    assert gradients[0].shape == gradients[1].shape == (count,)


COMPILED = """
import sys, torch
from plugins.density_head.von_mises import functions
grid, path = torch.load(sys.argv[1]), sys.argv[2]
results = []
for arguments in grid:
    density = torch.compile(functions.log_prob, fullgraph=True, dynamic=False)(*arguments)
    results.append((density.detach(), *torch.autograd.grad(density.sum(), arguments)))
torch.save(results, path)
"""


@pytest.mark.slow
def test_compiled_log_prob_and_gradients_agree_with_90_digits(tmp_path):
    """Compare in a separate process, since the type checks that tests switch on cannot be compiled."""
    columns = list(
        zip(*((3.0 + off, 3.0, kappa) for off in OFFSETS for kappa in CONCENTRATIONS), strict=True)
    )
    grid = [[leaf(column, dtype) for column in columns] for dtype in DTYPES]
    torch.save(grid, tmp_path / "grid.pt")
    command = [sys.executable, "-c", COMPILED, str(tmp_path / "grid.pt"), str(tmp_path / "results.pt")]
    process = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert process.returncode == 0, process.stderr
    for arguments, (density, *slopes) in zip(grid, torch.load(tmp_path / "results.pt"), strict=True):
        check_points(*arguments, density, slopes)


many_digits = cache(fit_coefficients.bessel)
KAPPAS = torch.tensor([0, 1e-30, 1e-8, 1e-3, 0.5, 1, 2, 7.0, 30, 1e3, 1e8, 1e12, 1e30], dtype=torch.float64)


@pytest.mark.parametrize("dtype", DTYPES)
def test_divergence_agrees_with_120_digits(dtype):
    mpmath.mp.dps = 130
    factors = torch.tensor([0, 1, 1 + 1e-6, 1.01, 2.7, 2.8], dtype=torch.float64)
    second = torch.cat([KAPPAS, *(factors * kappa for kappa in KAPPAS[1::3])]).to(dtype)
    first, second = (grid.flatten() for grid in torch.meshgrid(KAPPAS.to(dtype), second, indexing="ij"))
    zero = torch.zeros((), dtype=dtype)
    straight = integrals.kl_divergence(zero, first, zero, second)
    turned = integrals.kl_divergence(zero, first, zero + 0.25, second)
    assert (straight >= 0).all()
    for row in zip(first, second, straight, turned, strict=True):
        first_kappa, second_kappa = (mpmath.mpf(kappa.item()) for kappa in row[:2])
        logs, complements = zip(*(many_digits(kappa) for kappa in (first_kappa, second_kappa)), strict=True)
        bregman = (
            logs[1]
            + second_kappa
            - logs[0]
            - first_kappa
            - (1 - complements[0]) * (second_kappa - first_kappa)
        )
        turning = (1 - complements[0]) * second_kappa * 2 * mpmath.sin(mpmath.mpf("0.125")) ** 2
        for computed, reference in ((row[2], bregman), (row[3], bregman + turning)):
            assert error(computed, reference, abs(reference) + torch.finfo(dtype).tiny, dtype) < 16, row
    mpmath.mp.dps = 90


def test_divergence_of_equals_is_exactly_0_and_of_the_joint_is_the_sum():
    mean, kappa = torch.randn(13, 2), torch.stack([KAPPAS, KAPPAS], 1).float()
    assert (integrals.kl_divergence(mean, kappa, mean, kappa) == 0).all()
    first, second = VonMises(mean, kappa), VonMises(mean + 0.1, kappa + 1)
    parts = integrals.kl_divergence(mean, kappa, mean + 0.1, kappa + 1)
    torch.testing.assert_close(kl_divergence(first, second), parts.sum(-1))


@pytest.mark.parametrize("second", [1.5, 1.6, 9.0])
def test_divergence_has_first_and_second_derivatives(second):
    arguments = [
        torch.tensor([number], dtype=torch.float64, requires_grad=True) for number in (0.3, 1.5, -0.4, second)
    ]
    assert torch.autograd.gradcheck(integrals.kl_divergence, arguments)
    assert torch.autograd.gradgradcheck(integrals.kl_divergence, arguments)


def tail(offset, kappa):
    """Return the probability beyond `offset` on one side, by quadrature until the density has fallen by exp(-90)."""
    offset, kappa = mpmath.mpf(offset), mpmath.mpf(kappa)
    ends = [mpmath.sin(offset / 2) ** 2 + step / (2 * kappa) if kappa else 2 for step in (1, 4, 12, 30, 90)]
    ends = [2 * mpmath.asin(mpmath.sqrt(min(1, end))) for end in ends]
    fall = 2 * kappa * mpmath.sin(offset / 2) ** 2
    # quad stops at an absolute error, so that its integrand must not be small
    rest = mpmath.quad(lambda x: mpmath.exp(fall - 2 * kappa * mpmath.sin(x / 2) ** 2), [offset, *ends])
    return rest / (2 * mpmath.pi) * mpmath.exp(-fall - fit_coefficients.bessel(kappa)[0])


@pytest.mark.parametrize("kappa", [0, 1e-30, 1e-3, 0.5, 3.0, 30.0, 1e4, 1e12, 1e30])
def test_cdf_agrees_with_quadrature_in_both_tails(kappa):
    mpmath.mp.dps = 40
    zero, concentration = torch.zeros((), dtype=torch.float64), torch.tensor(kappa, dtype=torch.float64)
    for deviations in (0.0, 1e-6, 0.3, 0.7, 1.5, 3.0, 8.0, 25.0):
        offset = min(3.14, deviations / max(1.0, kappa) ** 0.5)
        reference = tail(offset, kappa)
        below = integrals.cdf(zero - offset, zero, concentration)
        above = integrals.cdf(zero + offset, zero, concentration)
        assert abs(below.item() - reference) <= 4e-15 * reference * max(1, -mpmath.log(reference))
        assert abs(above.item() - (1 - reference)) <= 1e-14
        turned = integrals.cdf(zero - offset + 4 * math.pi, zero, concentration)
        assert abs(turned.item() - reference - 2) <= 1e-14 + 2e-15 * max(1.0, kappa) ** 0.5
        single = integrals.cdf((zero - offset).float(), zero.float(), concentration.float())
        wide = integrals.cdf((zero - offset).float().double(), zero, concentration.float().double())
        assert single.dtype == torch.float32
        assert single == wide.float()
    mpmath.mp.dps = 90


@pytest.mark.parametrize("kappa", [1e-3, 1.0, 12.0, 45.0])
def test_cdf_agrees_with_scipy_and_rises(kappa):
    value = torch.linspace(-7, 7, 2001, dtype=torch.float64)
    probability = integrals.cdf(value, torch.zeros(()), torch.tensor(kappa))
    np.testing.assert_allclose(
        probability, stats.vonmises.cdf(value.numpy(), np.float32(kappa)), rtol=0, atol=1e-12
    )
    assert (probability.diff() >= -1e-15).all()
    assert probability[0] < 0 < 1 < probability[-1]


@pytest.mark.parametrize("kappa", [0.1, 1.0, 20.0])
def test_cdf_has_first_derivatives(kappa):
    value = torch.tensor([-3.0, -1.0, -0.05, 0.2, 2.0], dtype=torch.float64, requires_grad=True)
    mean, kappa = (
        torch.full((5,), number, dtype=torch.float64, requires_grad=True) for number in (0.1, kappa)
    )
    assert torch.autograd.gradcheck(integrals.cdf, (value, mean, kappa))


@pytest.mark.parametrize("kappa", [0, 1e-30, 1e-3, 0.3, 1, 3, 30, 1e4, 1e12, 1e30])
def test_arc_holds_its_mass(kappa):
    mass = torch.tensor(
        [0, 1e-12, 1e-3, 0.3, 0.5, 0.500001, 0.9, 0.99, 1 - 1e-6, 1 - 1e-9, 1], dtype=torch.float64
    )
    zero, concentration = torch.zeros((), dtype=torch.float64), torch.tensor(kappa, dtype=torch.float64)
    width = integrals.half_width(mass, concentration)
    below = integrals.cdf(-width, zero, concentration)
    np.testing.assert_allclose(integrals.cdf(width, zero, concentration) - below, mass, rtol=0, atol=2e-14)
    # the mass outside keeps its digits down to that of a last digit of π
    np.testing.assert_allclose(2 * below[5:-1], (1 - mass)[5:-1], rtol=1e-12, atol=4e-16)
    assert (width.diff() > 0).all()
    assert width[0] == 0
    assert width[-1] == math.pi


def test_an_arc_of_more_than_all_is_refused():
    with pytest.raises(ValueError, match=r"between 0 and 1, got values from 0.5 to 1.5"):
        integrals.half_width(torch.tensor([0.5, 1.5]), torch.ones(2))


@pytest.mark.parametrize("concentration", [10.0**power for power in range(-8, 13)] + [1.1, 1.2, 37.0])
def test_concentration_of_moments_inverts_the_moments(concentration):
    _, ratio, complement, _ = bessel(concentration)
    moments = [torch.tensor(float(moment), dtype=torch.float64) for moment in (ratio, complement)]
    assert functions.concentration_of_moments(*moments).item() == pytest.approx(concentration, rel=1e-12)


@pytest.mark.parametrize("power", range(-307, 0, 17))
def test_concentration_of_moments_is_finite_for_every_deviation(power):
    """Check small deviations V, for which κ = 1/2V + 1/4 + O(V) (Mardia & Jupp 2000, 5.3.10)."""
    deviation = torch.tensor(10.0**power, dtype=torch.float64)
    concentration = functions.concentration_of_moments(1 - deviation, deviation)
    assert concentration.item() == pytest.approx(
        (0.5 / deviation + 0.25).item(), rel=max(deviation.item(), 1e-12)
    )


def test_concentration_of_moments_at_its_ends():
    concentration = functions.concentration_of_moments(
        torch.tensor([0.0, -0.4, 1.0]), torch.tensor([1.0, 1.4, 0.0])
    )
    assert concentration.tolist() == [0.0, 0.0, math.inf]


@pytest.mark.parametrize("concentration", [0, 1e-30, 1e-3, 0.5, 1, 3, 30, 1e3, 1e6, 1e12, 1e16, 1e30])
def test_samples_follow_the_density(concentration):
    count = 20_000
    ways = []
    for fewest in WAYS.values():
        torch.manual_seed(3)
        with way(fewest):
            ways.append(
                functions.sample(torch.zeros(count, dtype=torch.float64), torch.full((count,), concentration))
            )
    samples, by_torch = ways
    torch.testing.assert_close(samples, by_torch, rtol=1e-11, atol=1e-14 / max(1, concentration) ** 0.5)
    assert samples.abs().max() <= math.pi
    if concentration > 1e6:  # there the density is normal to 1/κ
        law = stats.norm(scale=concentration**-0.5).cdf
    else:
        law = stats.vonmises(max(concentration, 1e-9)).cdf
    assert stats.kstest(samples.numpy(), law).pvalue > 1e-3
    assert len(samples.unique()) > 0.999 * count


@both_ways
def test_sampling_ends_whatever_it_is_given(fewest):
    with way(fewest):
        samples = functions.sample(torch.zeros(4), torch.tensor([math.nan, math.inf, 0.0, 1e38]))
    assert samples[0].isnan()
    assert samples[2:].isfinite().all()
    assert functions.sample(torch.zeros(0, 2), torch.zeros(0, 2)).shape == (0, 2)


@both_ways
def test_sampling_shifts_by_the_mean(fewest):
    torch.manual_seed(0)
    with way(fewest):
        samples = functions.sample(
            torch.full((1000,), 1e4 + 1.0, dtype=torch.float64), torch.full((1000,), 1e8)
        )
    torch.testing.assert_close((samples - 1e4 - 1.0).cos(), torch.ones(1000).double(), rtol=0, atol=1e-6)


ONE, TWO, THREE = (Target("angle", ("azimuth", "elevation", "tilt")[:count]) for count in (1, 2, 3))
PREDICTED, FIXED = "von_mises", {"name": "von_mises", "concentration": "fixed"}


def build_head(config=PREDICTED, target=ONE):
    return build("density_head", resolve("density_head", config), target=target)


def test_independent_angles_add_up():
    density = build_head(target=THREE)(torch.randn(2, 9))
    value = values(THREE, (2,))
    parts = [marginal(density, index).log_prob(value[:, index : index + 1]) for index in range(3)]
    torch.testing.assert_close(density.log_prob(value), sum(parts))
    torch.testing.assert_close(
        density.entropy(), sum(marginal(density, index).entropy() for index in range(3))
    )
    assert torch.equal(median(density, 1), density.mode)


def test_picked_components_are_those_at_the_index():
    density = VonMises(torch.randn(2, 4, 3), torch.rand(2, 4, 3))
    index = torch.tensor([[0, 3], [2, 1], [1, 1]])
    picked = pick(density, index)
    assert picked.batch_shape == (3, 2)
    for sample, row in np.ndindex(3, 2):
        assert torch.equal(picked.mean[sample, row], density.mean[row, index[sample, row]])
        assert torch.equal(picked.concentration[sample, row], density.concentration[row, index[sample, row]])


def test_fixed_loss_is_the_cosine_loss_up_to_a_constant():
    head, target = build_head(FIXED), torch.randn(50, 1)
    raw = torch.randn(50, 2)
    unit = raw / raw.norm(dim=-1, keepdim=True)
    cosine_loss = 1 - (unit * torch.cat([target.cos(), target.sin()], -1)).sum(-1)  # eq. 3.2
    constant = head.loss(raw, target) - cosine_loss
    torch.testing.assert_close(constant, constant[0].expand(50))


def test_the_scale_of_the_pair_has_a_floor_and_no_kink():
    raw = torch.tensor([-1e4, -60.0, -1e-9, 0.0, 1e-9], dtype=torch.float64, requires_grad=True)
    scale = scale_of_raw(raw)
    (slope,) = torch.autograd.grad(scale.sum(), raw)
    torch.testing.assert_close(scale, torch.tensor([LEAST_SCALE] * 2 + [1.0] * 3).double(), rtol=1e-8, atol=0)
    torch.testing.assert_close(slope, torch.tensor([0.0] * 2 + [1.0] * 3).double(), rtol=1e-8, atol=1e-30)


@pytest.mark.parametrize("shrunken", [-3.0, -20.0, -1e4])
def test_an_angle_given_up_is_found_again(shrunken):
    head, target = build_head(), 0.7 + 0.1 * torch.randn(64, 1)
    raw = torch.tensor([1e-4, -1e-4, shrunken], requires_grad=True)
    optimizer = torch.optim.Adam([raw], lr=0.05)
    for _ in range(400):
        optimizer.zero_grad()
        head.loss(raw.expand(64, -1), target).mean().backward()
        optimizer.step()
    density = head(raw)
    assert density.mean.item() == pytest.approx(0.7, abs=0.1)
    assert density.concentration.item() > 1


def test_calibrated_concentration_maximises_the_likelihood():
    head = build_head(FIXED, TWO).eval()
    torch.manual_seed(1)
    raw = torch.randn(400, 4)
    target = functions.sample(head(raw).mean, torch.tensor([40.0, 0.3]))
    before = head.loss(raw, target)
    head.calibrate(raw, target)
    density = head(raw)
    for index in (0, 1):
        alone = marginal(density, index)
        offsets = (target[:, index] - alone.mean[:, 0]).double().numpy()
        best = optimize.minimize_scalar(
            lambda kappa, offsets=offsets: -stats.vonmises.logpdf(offsets, kappa).sum(),
            bounds=(1e-3, 1e3),
            method="bounded",
            options={"xatol": 1e-6},
        ).x
        assert head.concentration[index].item() == pytest.approx(best, rel=1e-4)
    assert torch.equal(head.loss(raw, target), before)


def test_calibration_on_perfect_and_on_no_data():
    head = build_head(FIXED).eval()
    raw = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    head.calibrate(raw, head(raw).mean)
    assert head.concentration.item() == 1e12
    with pytest.raises(ValueError, match="this split is empty"):
        head.calibrate(raw[:0], raw[:0, :1])


def test_the_zero_pair_has_the_gradient_of_the_natural_parameter():
    # log p = η·(cos φ, sin φ) - log I0(|η|) with η the pair: at 0 the gradient is (cos φ, sin φ)
    head, target = build_head().double(), torch.tensor([[2.0]], dtype=torch.float64)
    for pair in ([0.0, 0.0], [1e-30, -1e-30], [-1e-12, 1e-13]):
        raw = torch.tensor([[*pair, 0.0]], dtype=torch.float64, requires_grad=True)
        (gradient,) = torch.autograd.grad(-head.loss(raw, target), raw)
        np.testing.assert_allclose(gradient[0, :2], [math.cos(2.0), math.sin(2.0)], rtol=1e-9)


def test_concentration_reaches_a_million_and_more():
    density = build_head()(torch.tensor([[30.0, 40.0, 60.0], [1.0, 0.0, 130.0], [0.0, 1.0, 3e38]]))
    assert density.concentration[:, 0].tolist() == pytest.approx([50 * 16.0**4, 33.5**4, 1e12])
    assert density.mean[:, 0].tolist() == pytest.approx([math.atan2(4, 3), 0, math.pi / 2])


@pytest.mark.parametrize("kind", ["real", "class"])
def test_other_targets_are_refused(kind):
    with pytest.raises(ConfigError, match=f"von_mises.*'{kind}'"):
        build_head(target=Target(kind, ("a", "b")))


@both_ways
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_angles_of_any_size_are_read_as_the_docstring_says(dtype, fewest, monkeypatch):
    """Check the density at large angles, also with gradient and in compiled code.

    float32 angles are read exactly; float64 angles beyond 4e8 radians have an error of one unit of their last digit.
    """
    monkeypatch.setattr(processor, "FEWEST", fewest)
    monkeypatch.setattr(processor, "FEWEST_ONCE", fewest)
    value = torch.logspace(6, 38, 129, dtype=torch.float64).to(dtype)
    value = torch.cat([value, -value])
    mean, kappa = torch.full_like(value, 0.7), torch.full_like(value, 2.0)
    with mpmath.workdps(100):
        difference = [
            mpmath.mpf(v) - mpmath.mpf(m) for v, m in zip(value.tolist(), mean.tolist(), strict=True)
        ]
        height = -mpmath.log(2 * mpmath.pi * mpmath.besseli(0, 2))
        wanted = torch.tensor([float(2 * mpmath.cos(d) + height) for d in difference], dtype=torch.float64)
        slope = torch.tensor([float(2 * mpmath.sin(d)) for d in difference], dtype=torch.float64)
    unit = (torch.nextafter(value.abs(), torch.tensor(torch.inf, dtype=dtype)) - value.abs()).double()
    limit = (
        2e-6 if dtype == torch.float32 else (2e-15 + 2.1 * unit.where(value.abs() > 4e8, 0)).clamp(max=4.01)
    )
    assert ((functions.log_prob(value, mean, kappa).double() - wanted).abs() <= limit).all()
    log_prob = functions.log_prob(value, mean.requires_grad_(), kappa)
    (by_mean,) = torch.autograd.grad(log_prob.sum(), mean)
    assert ((log_prob.double() - wanted).abs() <= limit).all() and (
        (by_mean.double() - slope).abs() <= limit
    ).all()
    # what is compiled, step by step: as exact up to 4e8 radians, beyond them never above or below the density's range
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    log_prob = functions.log_prob(value, mean, kappa).detach().double()
    near = value.abs() < 4e8
    assert ((log_prob - wanted).abs() <= 2e-6)[near].all()
    assert (log_prob >= -2.1 + float(height)).all() and (log_prob <= 2.1 + float(height)).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_concentration_at_its_ends_is_a_number_or_refused(dtype):
    """Check that results up to infinite κ are finite and those of a point mass, and that κ below 0 is refused."""
    mean = torch.tensor([[0.5], [3.0]], dtype=dtype)
    for kappa in (1e38, 3e38, math.inf, torch.finfo(dtype).max):
        density = VonMises(mean, torch.full_like(mean, kappa))
        at_mean, off_mean = density.log_prob(mean), density.log_prob(mean + 1)
        size = min(kappa, LARGEST[dtype])
        assert at_mean.tolist() == pytest.approx([math.log(size / (2 * math.pi)) / 2] * 2, rel=1e-6)
        assert (off_mean < -1e37).all() and not off_mean.isnan().any()
        assert density.entropy().tolist() == pytest.approx([0.5 - at_mean[0].item()] * 2, rel=1e-6)
        assert torch.equal(density.sample(), mean)
        assert arc_probability(density, mean - 0.1, mean + 0.1).tolist() == [1, 1]
        assert arc_probability(density, mean + 0.1, mean - 0.1).tolist() == [0, 0]
        kappa = torch.full_like(mean, kappa).requires_grad_()
        (slope,) = torch.autograd.grad(VonMises(mean, kappa).log_prob(mean).sum(), kappa)
        assert not slope.isnan().any()
    for kappa in (-1e-30, -1.0, -math.inf):
        with pytest.raises(ValueError, match=r"1 of 2 concentrations are negative.*expected κ ≥ 0"):
            VonMises(mean, torch.tensor([[1.0], [kappa]], dtype=dtype))
