import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import optimize

from plugins.uncertainty.scaling.likelihood import minimise, total, value_and_slope


def numbers(*values):
    return torch.tensor(values, dtype=torch.float64)


def free(*start):
    return numbers(*start), numbers(*[-np.inf] * len(start)), numbers(*[np.inf] * len(start))


def rosenbrock(x):
    return (100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2).sum()


@pytest.mark.parametrize("start", [(-1.2, 1.0), (3.0, -7.0), (0.0, 0.0, 0.0)])
def test_the_minimum_of_the_rosenbrock_function_is_reached(start):
    minimum = minimise([rosenbrock], *free(*start))
    torch.testing.assert_close(minimum.point, torch.ones(len(start)).double(), rtol=0, atol=1e-6)
    assert not minimum.active.any()


@pytest.mark.parametrize("seed", range(5))
def test_a_convex_sum_in_a_box_agrees_with_another_method(seed):
    generator = torch.Generator().manual_seed(seed)
    inputs = torch.randn(60, 3, generator=generator, dtype=torch.float64)
    margin = 1 - 2 * (torch.rand(60, generator=generator) < torch.sigmoid(2 * inputs[:, 0])).double()
    terms = [
        lambda x, rows=rows: torch.nn.functional.softplus(margin[rows] * (inputs[rows] @ x)).sum()
        for rows in torch.arange(60).split(16)
    ]
    lower, upper = numbers(-0.5, -0.2, -9.0), numbers(0.7, 0.3, 9.0)
    minimum = minimise(terms, torch.zeros(3).double(), lower, upper)
    wanted = optimize.minimize(
        lambda x: total(terms, torch.from_numpy(x)).item(),
        np.zeros(3),
        method="SLSQP",
        bounds=list(zip(lower, upper, strict=True)),
        options={"ftol": 1e-15},
    )
    assert minimum.value <= wanted.fun * (1 + 1e-13)
    np.testing.assert_allclose(minimum.point.numpy(), wanted.x, atol=1e-5)
    at = (np.abs(wanted.x - upper.numpy()) < 1e-9).astype(int) - (np.abs(wanted.x - lower.numpy()) < 1e-9)
    assert minimum.active.tolist() == at.tolist()


def test_coupled_parameters_slide_along_a_bound():
    hessian, middle = numbers([1.0, 0.99], [0.99, 1.0]), numbers(-3.0, 4.0)
    minimum = minimise(
        [lambda x: (x - middle) @ hessian @ (x - middle) / 2], numbers(0, 5), numbers(0, 0), numbers(10, 10)
    )
    # with x₁ = 0 the best is x₂ = 4 + 0.99 · (-3 - 0)
    torch.testing.assert_close(minimum.point, numbers(0.0, 4 - 0.99 * 3))
    assert minimum.active.tolist() == [-1, 0]


@pytest.mark.parametrize("start", [0.01, 0.5, 2.0, -1.0])
def test_negative_curvature_and_saddles(start):
    def wavy(x):
        return (torch.cos(3 * x) + 0.1 * x**2).sum()

    minimum = minimise([wavy], *free(start, -start))
    assert minimum.value < wavy(numbers(start, -start))
    assert torch.autograd.functional.jacobian(wavy, minimum.point).abs().max() < 1e-6
    assert torch.linalg.eigvalsh(torch.autograd.functional.hessian(wavy, minimum.point)).min() > 0


def test_flat_functions_stay_where_they_are():
    for term in (lambda x: 3 + 0 * x.sum(), lambda x: torch.tensor(2.0)):
        assert minimise([term], *free(0.3, -4.0)).point.tolist() == [0.3, -4.0]


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_a_minimum_at_infinity_ends_at_the_bound(scale):
    minimum = minimise([lambda x: scale * torch.exp(-x).sum()], numbers(0), numbers(-3), numbers(5))
    assert minimum.point.item() == 5.0 and minimum.active.item() == 1
    loose = minimise([lambda x: torch.nn.functional.softplus(-x).sum()], *free(0.0))
    assert loose.value < 1e-11 and loose.point.isfinite()


def test_a_fall_without_end_ends():
    assert minimise([lambda x: -(x**3).sum()], *free(1.0)).value < -1


def test_regions_that_are_not_numbers_are_stepped_around():
    minimum = minimise([lambda x: (x - torch.log(x)).sum()], *free(50.0, 1e-3))  # NaN below 0
    torch.testing.assert_close(minimum.point, torch.ones(2).double(), atol=1e-6, rtol=0)
    wall = minimise([lambda x: torch.where(x > 2, torch.nan, -x).sum()], *free(0.0))
    assert wall.point.item() == pytest.approx(2, abs=1e-6) and wall.point.item() <= 2


def test_values_of_single_precision_come_as_near_as_they_can():
    single = [lambda x: 1e3 * (x.float() - 0.3).square().sum() + 7]
    assert minimise(single, *free(4.0), rounding=1e-7).point.item() == pytest.approx(0.3, abs=1e-4)


def test_slopes_agree_with_finite_differences():
    point = numbers(0.3, -0.7, 1.1)
    terms = [rosenbrock, lambda x: torch.exp(x[0] * x[1]), lambda x: x[2] * 3, lambda x: torch.tensor(1.0)]
    value, slope = value_and_slope(terms, point)

    def whole(x):
        return total(terms, torch.from_numpy(x)).item()

    assert value == pytest.approx(whole(point.numpy()), rel=1e-14)
    np.testing.assert_allclose(slope, optimize.approx_fprime(point.numpy(), whole, 1e-7), rtol=1e-4)


@settings(max_examples=60, deadline=None)
@example(start=[2.40625, 2.5, 2.5, 0.0], low=1.5, width=1.625, seed=605)  # SciPy stops far from any minimum
@given(
    st.lists(st.floats(-5, 5), min_size=2, max_size=4),
    st.floats(-3, 3),
    st.floats(0, 4),
    st.integers(0, 10**6),
)
def test_never_above_the_start_never_outside_the_box(start, low, width, seed):
    generator = torch.Generator().manual_seed(seed)
    count = len(start)
    bend = torch.randn(count, count, generator=generator, dtype=torch.float64)
    shift = 3 * torch.randn(count, generator=generator, dtype=torch.float64)

    def wild(x):
        return torch.sin(bend @ x).sum() + 0.05 * ((x - shift) ** 2).sum() + torch.exp(-x[0])

    lower, upper = numbers(*[low] * count), numbers(*[low + width] * count)
    begin = numbers(*start).clamp(lower, upper)
    minimum = minimise([wild], begin, lower, upper)
    assert minimum.value <= wild(begin).item()
    assert (minimum.point >= lower).all() and (minimum.point <= upper).all()
    # no small step within the box is better: the point is stationary there
    slope = torch.autograd.functional.jacobian(wild, minimum.point)
    assert ((minimum.point - slope).clamp(lower, upper) - minimum.point).abs().max() < 1e-3
