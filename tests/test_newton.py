import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize

from framework.calibration.newton import derivatives, minimise

INFINITE = torch.tensor(math.inf, dtype=torch.float64)


def free(*numbers):
    start = torch.tensor(numbers, dtype=torch.float64)
    return start, -INFINITE.expand_as(start), INFINITE.expand_as(start)


def rosenbrock(x):
    return (100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2).sum()


def scipy_of(term):
    return lambda x: term(torch.from_numpy(np.asarray(x, dtype=np.float64))).item()


@pytest.mark.parametrize("start", [(-1.2, 1.0), (3.0, -7.0), (0.0, 0.0, 0.0)])
def test_the_curved_valley(start):
    found = minimise([rosenbrock], *free(*start))
    assert found.converged and found.iterations < 100
    torch.testing.assert_close(found.point, torch.ones(len(start)).double(), rtol=0, atol=1e-6)
    assert not found.active.any()


def logistic(seed, samples=60):
    generator = torch.Generator().manual_seed(seed)
    inputs = torch.randn(samples, 3, generator=generator, dtype=torch.float64)
    labels = (torch.rand(samples, generator=generator) < torch.sigmoid(2 * inputs[:, 0])).double()
    margin = 1 - 2 * labels
    return [
        lambda x, rows=rows: torch.nn.functional.softplus(margin[rows] * (inputs[rows] @ x)).sum()
        for rows in torch.arange(samples).split(16)
    ]


@pytest.mark.parametrize("seed", range(5))
def test_a_convex_sum_in_a_box_agrees_with_scipy(seed):
    terms = logistic(seed)
    lower, upper = torch.tensor([-0.5, -0.2, -9.0]).double(), torch.tensor([0.7, 0.3, 9.0]).double()
    found = minimise(terms, torch.zeros(3), lower, upper)
    whole = scipy_of(lambda x: sum(term(x) for term in terms))
    wanted = optimize.minimize(
        whole,
        np.zeros(3),
        method="L-BFGS-B",
        bounds=list(zip(lower, upper, strict=True)),
        options={"ftol": 1e-15, "gtol": 1e-10},
    )
    assert found.converged
    assert found.value <= wanted.fun * (1 + 1e-13)
    np.testing.assert_allclose(found.point.numpy(), wanted.x, atol=1e-5)
    wanted_active = (np.abs(wanted.x - upper.numpy()) < 1e-9).astype(int)
    wanted_active -= np.abs(wanted.x - lower.numpy()) < 1e-9
    assert found.active.tolist() == wanted_active.tolist()


def test_coupled_parameters_slide_along_a_bound():
    # Newton's step points out of the box in one parameter while the slope points in: it must not stop there
    hessian = torch.tensor([[1.0, 0.99], [0.99, 1.0]]).double()
    middle = torch.tensor([-3.0, 4.0]).double()
    found = minimise(
        [lambda x: (x - middle) @ hessian @ (x - middle) / 2],
        torch.tensor([0.0, 5.0]),
        torch.zeros(2),
        torch.full((2,), 10.0),
    )
    # with x₁ = 0 the best is x₂ = 4 + 0.99 · (-3 - 0)
    torch.testing.assert_close(found.point, torch.tensor([0.0, 4 - 0.99 * 3]).double())
    assert found.converged and found.active.tolist() == [-1, 0]


def test_negative_curvature_and_saddles():
    def wavy(x):
        return (torch.cos(3 * x) + 0.1 * x**2).sum()

    for start in (0.01, 0.5, 2.0, -1.0):
        found = minimise([wavy], *free(start, -start))
        slope = torch.autograd.functional.jacobian(wavy, found.point)
        assert found.converged and found.value < wavy(torch.tensor([start, -start]).double())
        assert slope.abs().max() < 1e-6
        assert torch.linalg.eigvalsh(found.hessian).min() > 0


def test_flat_functions_stay_where_they_are():
    for term in (lambda x: 3 + 0 * x.sum(), lambda x: torch.tensor(2.0)):
        found = minimise([term], *free(0.3, -4.0))
        assert found.point.tolist() == [0.3, -4.0] and found.converged
        assert not found.hessian.any()


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_a_minimum_at_infinity_ends_at_the_bound(scale):
    lower, upper = torch.tensor([-3.0]), torch.tensor([5.0])
    found = minimise([lambda x: scale * torch.exp(-x).sum()], torch.zeros(1), lower, upper)
    assert found.converged and found.point.item() == 5.0 and found.active.item() == 1
    # without a bound it goes on until nothing is left to gain, and ends
    loose = minimise([lambda x: torch.nn.functional.softplus(-x).sum()], *free(0.0))
    assert loose.converged and loose.value < 1e-11 and math.isfinite(loose.point.item())


def test_a_fall_without_end_ends_and_says_so():
    found = minimise([lambda x: -(x**3).sum()], *free(1.0), iterations=50)
    assert not found.converged and found.iterations <= 50 and found.point.isfinite().all()


def test_regions_that_are_not_numbers_are_stepped_around():
    def guarded(x):  # NaN below 0: log of a negative number
        return (x - torch.log(x)).sum()

    found = minimise([guarded], *free(50.0, 1e-3))
    torch.testing.assert_close(found.point, torch.ones(2).double(), atol=1e-6, rtol=0)
    wall = minimise([lambda x: torch.where(x > 2, torch.nan, -x).sum()], *free(0.0))
    assert wall.point.item() == pytest.approx(2, abs=1e-6) and wall.point.item() <= 2


def test_values_of_single_precision_come_as_near_as_they_can():
    single = [lambda x: 1e3 * (x.float() - 0.3).square().sum() + 7]
    found = minimise(single, *free(4.0))
    assert found.converged and found.point.item() == pytest.approx(0.3, abs=1e-4)


def test_derivatives_agree_with_finite_differences():
    point = torch.tensor([0.3, -0.7, 1.1]).double()
    terms = [rosenbrock, lambda x: torch.exp(x[0] * x[1]), lambda x: x[2] * 3, lambda x: torch.tensor(1.0)]
    value, slope, hessian = derivatives(terms, point)
    whole = scipy_of(lambda x: sum(term(x) for term in terms))
    assert value.item() == pytest.approx(whole(point.numpy()), rel=1e-14)
    np.testing.assert_allclose(slope.numpy(), optimize.approx_fprime(point.numpy(), whole, 1e-7), rtol=1e-4)
    for row in range(3):
        step = torch.zeros(3).double()
        step[row] = 1e-5
        ahead, behind = (derivatives(terms, point + sign * step)[1] for sign in (1, -1))
        np.testing.assert_allclose(hessian[row].numpy(), ((ahead - behind) / 2e-5).numpy(), atol=1e-5)


def test_bad_starts_get_a_sentence():
    with pytest.raises(ValueError, match="Start elsewhere"):
        minimise([lambda x: torch.log(x).sum()], *free(-1.0))
    with pytest.raises(ValueError, match="is empty; wanted lower ≤ upper"):
        minimise([rosenbrock], torch.zeros(2), torch.ones(2), torch.zeros(2))


@settings(max_examples=60, deadline=None)
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

    lower, upper = torch.full((count,), low), torch.full((count,), low + width)
    begin = torch.tensor(start)
    found = minimise([wild], begin, lower, upper)
    assert found.value <= wild(begin.double().clamp(lower.double(), upper.double())).item()
    assert (found.point >= lower.double()).all() and (found.point <= upper.double()).all()
    assert found.converged
    # no small step within the box is better: the point is stationary there
    slope = torch.autograd.functional.jacobian(wild, found.point)
    inward = (found.point - slope).clamp(lower.double(), upper.double()) - found.point
    assert inward.abs().max() < 1e-3
