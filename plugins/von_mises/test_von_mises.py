import math
from functools import cache

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize, stats

from framework import testing
from framework.density import marginal, median, pick
from framework.errors import ConfigError
from framework.schema import build, resolve
from framework.target import Target
from plugins.von_mises import fit_coefficients, functions
from plugins.von_mises.coefficients import PIECES
from plugins.von_mises.density import VonMises

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
LIMIT = 8  # units of machine epsilon; 16 is wanted


@cache
def bessel(concentration):
    """log(I0(κ) exp(-κ)), A(κ), 1 - A(κ), A'(κ)."""
    kappa = mpmath.mpf(concentration)
    zero, one = mpmath.besseli(0, kappa), mpmath.besseli(1, kappa)
    ratio = one / zero
    slope = 1 - ratio**2 - ratio / kappa if kappa else mpmath.mpf(1) / 2
    return mpmath.log(zero) - kappa, ratio, 1 - ratio, slope


def leaf(number, dtype):
    return torch.tensor(number, dtype=dtype, requires_grad=True)


def error(found, reference, scale, dtype):
    """In machine epsilons of `scale`."""
    return float(abs(mpmath.mpf(found.item()) - reference) / scale) / torch.finfo(dtype).eps


def check_point(value, mean, concentration):
    """log_prob and its three gradients at one point against 90 digits."""
    dtype = value.dtype
    found = functions.log_prob(value, mean, concentration)
    by_value, by_mean, by_concentration = torch.autograd.grad(found, (value, mean, concentration))
    kappa = mpmath.mpf(concentration.item())
    scaled, _, complement, _ = bessel(concentration.item())
    difference = mpmath.mpf(value.item()) - mpmath.mpf(mean.item())
    fall = 2 * mpmath.sin(difference / 2) ** 2
    height = -mpmath.log(2 * mpmath.pi) - scaled
    # log p is the difference of two terms, dlogp/dκ of two others: errors are relative to the terms
    assert error(found, height - kappa * fall, max(1, abs(height), kappa * fall), dtype) < LIMIT
    assert error(by_concentration, complement - fall, complement + fall, dtype) < LIMIT
    turning = -kappa * mpmath.sin(difference)
    # the last term: of a difference that nearly is a multiple of π only eps² is lost
    scale = abs(turning) + kappa * torch.finfo(dtype).eps + torch.finfo(dtype).tiny
    assert error(by_value, turning, scale, dtype) < LIMIT
    assert by_mean == -by_value


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
    for found, reference, scale in (
        (functions.log_peak(kappa), height, max(1, abs(height))),
        (functions.entropy(kappa), entropy, max(1, abs(entropy))),
        (functions.mean_resultant(kappa), ratio, ratio + tiny),
        (functions.mean_deviation(kappa), complement, complement),
        (functions.mean_resultant_slope(kappa), slope, slope + tiny),
    ):
        assert error(found, reference, scale, dtype) < LIMIT
    for function, reference in (
        (functions.log_peak, complement),
        (functions.entropy, -exact * slope),
        (functions.mean_resultant, slope),
        (functions.mean_deviation, -slope),
    ):
        (found,) = torch.autograd.grad(function(kappa), kappa)
        assert error(found, reference, abs(reference) + tiny, dtype) < LIMIT


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", fit_coefficients.NAMES)
def test_no_seam_between_two_pieces(name, dtype):
    pieces = PIECES[str(dtype).removeprefix("torch.")][name]
    for middle, half_width, _ in pieces[1:]:
        edge = 2 / (middle - half_width) - 2
        near = torch.tensor(edge, dtype=dtype) * (1 + torch.finfo(dtype).eps * torch.arange(-40, 41))
        found = functions._polynomial(name, near.to(dtype))
        assert (found.diff().abs() <= 4 * torch.finfo(dtype).eps * found[1:].abs()).all()


def test_entropy_agrees_with_scipy():
    kappa = torch.logspace(-4, 3, 50, dtype=torch.float64)
    np.testing.assert_allclose(functions.entropy(kappa), stats.vonmises.entropy(kappa.numpy()), rtol=1e-11)


def test_the_coefficients_are_those_the_script_writes():
    edges = fit_coefficients.PIECES["float64"]
    low, high = mpmath.mpf(edges[1]), mpmath.mpf(edges[2])
    for which, name in enumerate(fit_coefficients.NAMES):
        written = fit_coefficients.interpolate(low, high, which, fit_coefficients.TOLERANCE["float64"])
        assert PIECES["float64"][name][1][2] == tuple(float(number) for number in written)


@pytest.mark.parametrize("concentration", [0.0, 1e-6, 0.5, 3.75, 20.0, 1e3])
def test_first_and_second_derivatives_agree_with_finite_differences(concentration):
    arguments = [
        torch.tensor(numbers, dtype=torch.float64, requires_grad=True)
        for numbers in ([[0.3], [-2.0]], [0.1, 3.0], [concentration] * 2)
    ]
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


# raised by the compiler itself
@pytest.mark.filterwarnings("ignore:.*should not be instantiated:DeprecationWarning")
def test_log_prob_is_one_graph():
    compiled = torch.compile(functions.log_prob, backend="eager", fullgraph=True)
    arguments = torch.randn(7), torch.randn(7), torch.rand(7)
    assert torch.equal(compiled(*arguments), functions.log_prob(*arguments))


@pytest.mark.parametrize("concentration", [10.0**power for power in range(-8, 13)] + [1.1, 1.2, 37.0])
def test_concentration_of_moments_inverts_the_moments(concentration):
    _, ratio, complement, _ = bessel(concentration)
    moments = [torch.tensor(float(moment), dtype=torch.float64) for moment in (ratio, complement)]
    assert functions.concentration_of_moments(*moments).item() == pytest.approx(concentration, rel=1e-12)


def test_concentration_of_moments_at_its_ends():
    found = functions.concentration_of_moments(torch.tensor([0.0, -0.4, 1.0]), torch.tensor([1.0, 1.4, 0.0]))
    assert found.tolist() == [0.0, 0.0, math.inf]


@pytest.mark.parametrize("concentration", [0, 1e-30, 1e-3, 0.5, 1, 3, 30, 1e3, 1e6, 1e12, 1e16, 1e30])
def test_samples_follow_the_density(concentration):
    torch.manual_seed(3)
    count = 20_000
    drawn = functions.sample(torch.zeros(count, dtype=torch.float64), torch.full((count,), concentration))
    assert drawn.abs().max() <= math.pi
    if concentration > 1e6:  # there the density is normal to 1/κ
        law = stats.norm(scale=concentration**-0.5).cdf
    else:
        law = stats.vonmises(max(concentration, 1e-9)).cdf
    assert stats.kstest(drawn.numpy(), law).pvalue > 1e-3
    assert len(drawn.unique()) > 0.999 * count


def test_sampling_ends_whatever_it_is_given():
    drawn = functions.sample(torch.zeros(4), torch.tensor([math.nan, math.inf, 0.0, 1e38]))
    assert drawn[0].isnan()
    assert drawn[2:].isfinite().all()
    assert functions.sample(torch.zeros(0, 2), torch.zeros(0, 2)).shape == (0, 2)


def test_sampling_shifts_by_the_mean():
    torch.manual_seed(0)
    drawn = functions.sample(torch.full((1000,), 1e4 + 1.0, dtype=torch.float64), torch.full((1000,), 1e8))
    torch.testing.assert_close((drawn - 1e4 - 1.0).cos(), torch.ones(1000).double(), rtol=0, atol=1e-6)


ONE, TWO, THREE = (Target("angle", ("azimuth", "elevation", "tilt")[:count]) for count in (1, 2, 3))
PREDICTED, FIXED = "von_mises", {"name": "von_mises", "concentration": "fixed"}
FLOORED = {"name": "von_mises", "floor": 0.5}
ROWS = [(PREDICTED, ONE), (PREDICTED, TWO), (PREDICTED, THREE), (FIXED, ONE), (FIXED, TWO), (FLOORED, TWO)]


def head(config=PREDICTED, target=ONE):
    return build("density_head", resolve("density_head", config), target=target)


@pytest.mark.parametrize("config, target", ROWS)
def test_contract(config, target):
    testing.check_head(lambda: head(config, target), target)


@pytest.mark.parametrize("config, target", ROWS)
def test_density(config, target):
    made = head(config, target).eval()
    with torch.no_grad():
        density = made(3 * testing.raws(made, (3,)))
        testing.check_periodic(
            VonMises(density.mean.double(), density.concentration.double()),
            testing.values(target, (3,)).double(),
            limit=1e-9,
        )
        alone = marginal(density, len(target.names) - 1)
        testing.check_normalised(alone)
        testing.check_median(alone)
        testing.check_samples(alone)
        if target is TWO:
            testing.check_normalised(density)
            testing.check_samples(density)
            testing.check_marginal(density)
        value = testing.values(target, (3,))
        reference = stats.vonmises.logpdf(
            value.double(), density.concentration.double(), density.mean.double()
        ).sum(-1)
        testing.check_log_prob(density, value, torch.from_numpy(reference), limit=2e-6)


def test_independent_angles_add_up():
    density = head(target=THREE)(testing.raws(head(target=THREE), (2,)))
    value = testing.values(THREE, (2,))
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
    made, target = head(FIXED), torch.randn(50, 1)
    raw = torch.randn(50, 2)
    unit = raw / raw.norm(dim=-1, keepdim=True)
    cosine_loss = 1 - (unit * torch.cat([target.cos(), target.sin()], -1)).sum(-1)  # eq. 3.2
    constant = made.loss(raw, target) - cosine_loss
    torch.testing.assert_close(constant, constant[0].expand(50))


def test_calibrated_concentration_maximises_the_likelihood():
    made = head(FIXED, TWO).eval()
    torch.manual_seed(1)
    raw = torch.randn(400, 4)
    target = functions.sample(made(raw).mean, torch.tensor([40.0, 0.3]))
    before = made.loss(raw, target)
    made.calibrate(raw, target)
    density = made(raw)
    for index in (0, 1):
        alone = marginal(density, index)
        offsets = (target[:, index] - alone.mean[:, 0]).double().numpy()
        best = optimize.minimize_scalar(
            lambda kappa, offsets=offsets: -stats.vonmises.logpdf(offsets, kappa).sum(),
            bounds=(1e-3, 1e3),
            method="bounded",
            options={"xatol": 1e-6},
        ).x
        assert made.concentration[index].item() == pytest.approx(best, rel=1e-4)
    assert torch.equal(made.loss(raw, target), before)


def test_calibration_on_perfect_and_on_no_data():
    made = head(FIXED).eval()
    raw = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    made.calibrate(raw, made(raw).mean)
    assert made.concentration.item() == 1e12
    with pytest.raises(ValueError, match="got none"):
        made.calibrate(raw[:0], raw[:0, :1])


def test_the_zero_pair_has_the_gradient_of_the_natural_parameter():
    # log p = η·(cos φ, sin φ) - log I0(|η|) with η the pair: at 0 the gradient is (cos φ, sin φ)
    made, target = head().double(), torch.tensor([[2.0]], dtype=torch.float64)
    for pair in ([0.0, 0.0], [1e-30, -1e-30], [-1e-12, 1e-13]):
        raw = torch.tensor([[*pair, 0.0]], dtype=torch.float64, requires_grad=True)
        (gradient,) = torch.autograd.grad(-made.loss(raw, target), raw)
        np.testing.assert_allclose(gradient[0, :2], [math.cos(2.0), math.sin(2.0)], rtol=1e-9)


def test_concentration_reaches_a_million_and_more():
    density = head()(torch.tensor([[30.0, 40.0, 60.0], [1.0, 0.0, 130.0], [0.0, 1.0, 3e38]]))
    assert density.concentration[:, 0].tolist() == pytest.approx([50 * 16.0**4, 33.5**4, 1e12])
    assert density.mean[:, 0].tolist() == pytest.approx([math.atan2(4, 3), 0, math.pi / 2])


@pytest.mark.parametrize("kind", ["real", "class"])
def test_other_targets_are_refused(kind):
    with pytest.raises(ConfigError, match=f"von_mises.*'{kind}'"):
        head(target=Target(kind, ("a", "b")))
