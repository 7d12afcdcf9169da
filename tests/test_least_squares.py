"""Bounded least squares for many problems at once, compared with SciPy for each problem."""

import math

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import optimize

from framework.least_squares.solution import Status
from framework.least_squares.solver import least_squares

TIMES = torch.linspace(0, 4, 40, dtype=torch.float64)
INFINITE = torch.tensor(math.inf, dtype=torch.float64)


class Decays:
    """Model a exp(-b t) + c, measured with noise."""

    def __init__(self, measured):
        self.measured = measured

    def __call__(self, parameters, rows):
        a, b, c = parameters.unsqueeze(-1).unbind(1)
        decay = torch.exp(-b * TIMES)
        jacobian = torch.stack((decay, -a * TIMES * decay, torch.ones_like(decay)), -1)
        return a * decay + c - self.measured[rows], jacobian

    def curvature(self, parameters, rows):
        a, b, _ = parameters.unsqueeze(-1).unbind(1)
        residuals = self(parameters, rows)[0].nan_to_num(0.0)
        moved = -TIMES * torch.exp(-b * TIMES) * residuals
        found = parameters.new_zeros(len(parameters), 3, 3)
        found[:, 0, 1] = found[:, 1, 0] = moved.sum(-1)
        found[:, 1, 1] = -(a * TIMES * moved).sum(-1)
        return found

    def scipys(self, row, start, lower, upper):
        def both(x):
            return self(torch.tensor(x)[None], torch.tensor([row]))

        return optimize.least_squares(
            lambda x: both(x)[0][0].numpy(),
            start,
            lambda x: both(x)[1][0].numpy(),
            bounds=(lower, upper),
            ftol=1e-15,
            xtol=1e-15,
            gtol=1e-15,
            max_nfev=2000,
        )


def linear(matrix, wanted):
    """Residuals A x - y of one matrix (r, p) for all problems, or of one (problem, r, p) for each."""

    def model(parameters, rows):
        chosen = matrix[rows] if matrix.dim() == 3 else matrix.expand(len(rows), -1, -1)
        return torch.bmm(chosen, parameters.unsqueeze(-1)).squeeze(-1) - wanted[rows], chosen

    return model


def decays(count, noise, seed=0):
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(count, 3, generator=generator, dtype=torch.float64) * 2 + 0.2
    clean = truth[:, :1] * torch.exp(-truth[:, 1:2] * TIMES) + truth[:, 2:]
    return clean + noise * torch.randn(count, 40, generator=generator, dtype=torch.float64), truth


@pytest.mark.parametrize("curved", [False, True])
@pytest.mark.parametrize("top", [10.0, 1.0], ids=["free", "at bounds"])
def test_each_problem_ends_where_scipy_ends(curved, top):
    measured, _ = decays(25, 0.05)
    model = Decays(measured)
    lower, upper = torch.zeros(3).double(), torch.full((3,), top).double()
    found = least_squares(
        model, torch.full((25, 3), 0.5), lower, upper, curvature=model.curvature if curved else None
    )
    for row in range(25):
        wanted = model.scipys(row, [0.5] * 3, lower.numpy(), upper.numpy())
        assert found.cost[row] <= wanted.cost * (1 + 1e-9)
        np.testing.assert_allclose(found.parameters[row].numpy(), wanted.x, rtol=1e-6, atol=1e-7)
        if top < 10:
            continue
        inverse = np.linalg.inv(wanted.jac.T @ wanted.jac) * 2 * wanted.cost / 37
        np.testing.assert_allclose(found.covariance[row].numpy(), inverse, rtol=1e-4, atol=1e-9)
    if top == 10:
        assert bool((found.status > 0).all()) and found.rank.tolist() == [3] * 25
    assert bool((found.parameters <= upper).all()) and bool((found.parameters >= lower).all())


def test_neither_company_nor_order_changes_an_answer():
    measured, _ = decays(18, 0.05)
    model, box = Decays(measured), (torch.zeros(3), torch.full((3,), 5.0))
    start = torch.full((18, 3), 0.5)
    whole = least_squares(model, start, *box)
    few = least_squares(model, start, *box, together=3)
    torch.testing.assert_close(few.parameters, whole.parameters, rtol=1e-9, atol=1e-9)
    assert torch.equal(few.status, whole.status)
    back = least_squares(Decays(measured.flip(0)), start, *box)
    torch.testing.assert_close(back.parameters.flip(0), whole.parameters, rtol=1e-9, atol=1e-9)


def test_a_model_that_sums_up_by_itself_is_fitted_alike_and_keeps_its_numbers():
    measured, _ = decays(12, 0.05)
    measured[3] = math.nan
    measured[4] = 0.0  # no decay: its rate is not determined
    measured[5, ::3] = math.nan
    model, kept = Decays(measured), []

    def normal(parameters, rows):
        residuals, jacobian = model(parameters, rows)
        there = ~residuals.isnan()
        residuals, jacobian = residuals.where(there, 0.0), jacobian.where(there.unsqueeze(-1), 0.0)
        gradient = torch.einsum("nrp,nr->np", jacobian, residuals)
        found = residuals.square().sum(-1) / 2, gradient, jacobian.mT @ jacobian, there.sum(-1)
        kept.append((found, [part.clone() for part in found]))
        return found

    box = (torch.full((12, 3), 0.5), torch.zeros(3), torch.full((3,), 5.0))
    plain = least_squares(model, *box, curvature=model.curvature)
    summed = least_squares(model, *box, normal=normal, curvature=model.curvature)
    assert torch.equal(plain.status, summed.status) and torch.equal(plain.rank, summed.rank)
    assert plain.status[3:5].tolist() == [Status.NOT_FINITE, Status.ILL_POSED]
    for name in ("parameters", "cost", "covariance"):
        torch.testing.assert_close(getattr(plain, name), getattr(summed, name), rtol=1e-8, atol=1e-10)
    assert kept and all(torch.equal(*pair) for both in kept for pair in zip(*both, strict=True))


def test_units_do_not_matter():
    """Parameters in micrometres and megametres give the same fit."""
    measured, _ = decays(20, 0.05)
    model, unit = Decays(measured), torch.tensor([1e-6, 1e6, 1e3]).double()

    def scaled(parameters, rows):
        residuals, jacobian = model(parameters * unit, rows)
        return residuals, jacobian * unit

    start, top = torch.full((20, 3), 0.5), torch.full((3,), 5.0).double()
    plain = least_squares(model, start, top * 0, top)
    other = least_squares(scaled, start / unit, top * 0, top / unit)
    torch.testing.assert_close(other.parameters * unit, plain.parameters, rtol=1e-7, atol=1e-9)
    assert torch.equal(other.status > 0, plain.status > 0)


def test_missing_residuals_are_as_if_never_measured():
    measured, _ = decays(8, 0.05)
    holes = measured.clone()
    holes[:4, 5:17] = math.nan
    found = least_squares(Decays(holes), torch.full((8, 3), 0.5), torch.zeros(3), torch.full((3,), 5.0))
    for row in range(4):
        kept = np.flatnonzero(~holes[row].isnan().numpy())

        def misfit(x, row=row, kept=kept):
            return x[0] * np.exp(-x[1] * TIMES.numpy()[kept]) + x[2] - measured[row].numpy()[kept]

        wanted = optimize.least_squares(misfit, [0.5] * 3, bounds=(0, 5), ftol=1e-15, xtol=1e-15, gtol=1e-15)
        np.testing.assert_allclose(found.parameters[row].numpy(), wanted.x, rtol=1e-5)
        inverse = np.linalg.inv(wanted.jac.T @ wanted.jac) * 2 * wanted.cost / (len(kept) - 3)
        np.testing.assert_allclose(found.covariance[row].numpy(), inverse, rtol=1e-3, atol=1e-9)


def test_what_cannot_be_fitted_is_said_and_is_no_nan():
    measured, _ = decays(6, 0.05)
    measured[0] = math.nan  # nothing measured
    measured[1] = math.inf
    measured[2] = 0.0  # flat: a decay without amplitude has no rate
    measured[3, 1:] = math.nan  # one number for three parameters
    measured[4, 7] = 1e9  # a spike
    found = least_squares(Decays(measured), torch.full((6, 3), 0.5), torch.zeros(3), torch.full((3,), 5.0))
    wanted = [Status.NOT_FINITE, Status.NOT_FINITE, Status.ILL_POSED, Status.ILL_POSED]
    assert found.status[:4].tolist() == wanted
    assert found.status[4] > 0 or found.status[4] == Status.ILL_POSED
    assert found.status[5] > 0
    for part in (found.parameters, found.cost, found.covariance):
        assert not bool(part.isnan().any())
    assert torch.equal(found.parameters[0], torch.full((3,), 0.5).double())
    assert found.rank[:4].tolist() == [0, 0, 2, 1]
    assert found.cost[3] < 1e-20 and found.parameters[3].isfinite().all()


def test_a_model_that_breaks_off_the_road_is_walked_around():
    """log x has no value below 0, where a full step would lead."""
    wanted = torch.tensor([[-3.0], [5.0]]).double()

    def model(parameters, rows):
        return parameters.log() - wanted[rows], parameters.reciprocal().unsqueeze(-1)

    found = least_squares(model, torch.full((2, 1), 10.0), -INFINITE, INFINITE)
    torch.testing.assert_close(found.parameters, wanted.exp(), rtol=1e-9, atol=0.0)


@pytest.mark.parametrize(
    ("name", "start"), [("rosenbrock", (-1.2, 1.0)), ("rosenbrock", (-50.0, 80.0)), ("valley", (0.0, 1.0))]
)
def test_narrow_valleys_are_followed_to_their_end(name, start):
    """More, Garbow & Hillstrom (1981), problems 1 and 3: minima with cost 0."""

    def rosenbrock(x):
        one, two = x.unbind(-1)
        return torch.stack((10 * (two - one**2), 1 - one), -1)

    def valley(x):  # Powell's badly scaled function
        one, two = x.unbind(-1)
        return torch.stack((1e4 * one * two - 1, (-one).exp() + (-two).exp() - 1.0001), -1)

    function = {"rosenbrock": rosenbrock, "valley": valley}[name]

    def model(parameters, rows):
        jacobian = torch.stack([torch.func.jacrev(function)(x) for x in parameters])
        return function(parameters), jacobian.detach()

    found = least_squares(model, torch.tensor([start]), -INFINITE, INFINITE, most=1000)
    assert found.cost.item() < 1e-20, found


@settings(max_examples=25, deadline=None)
@example(seed=0, size=2, more=4, decades=12.0, boxed=False)  # rounding hides what the weak direction gains
@example(seed=0, size=6, more=5, decades=9.3125, boxed=False)  # no pivot tells how weak it is
@example(seed=0, size=6, more=0, decades=4.0, boxed=True)  # the way leads through a corner
@given(
    seed=st.integers(0, 2**31),
    size=st.integers(1, 7),
    more=st.integers(0, 9),
    decades=st.floats(0, 12),
    boxed=st.booleans(),
)
def test_linear_problems_of_any_condition(seed, size, more, decades, boxed):
    """The smallest cost equals that of SciPy's bounded solver, or of a QR decomposition."""
    generator = np.random.default_rng(seed)
    rows = size + more
    left, _ = np.linalg.qr(generator.normal(size=(rows, size)))
    right, _ = np.linalg.qr(generator.normal(size=(size, size)))
    matrix = left * np.logspace(0, -decades, size) @ right.T
    wanted = generator.normal(size=rows)
    if not boxed:  # a minimum that is 1 away in every direction, however weak
        wanted = matrix @ generator.normal(size=size)
    side = 0.3 if boxed else math.inf
    box = torch.full((size,), side).double()
    model = linear(torch.tensor(matrix), torch.tensor(wanted)[None])
    found = least_squares(model, torch.zeros(1, size), -box, box, most=500)
    if boxed:
        least = optimize.lsq_linear(matrix, wanted, (-side, side), method="bvls", tol=1e-15).cost
    else:
        least = 0.0
    scale = wanted @ wanted
    assert found.cost.item() <= least * (1 + 1e-8) + 1e-24 * scale + (1e-13 * scale if boxed else 0)
    assert bool(found.parameters.isfinite().all()) and bool(found.covariance.isfinite().all())
    assert int(found.steps) < 500 and int(found.status) != Status.LIMIT
    values = np.linalg.svd(matrix / np.linalg.norm(matrix, axis=0), compute_uv=False)
    if values[-1] < 1e-9 * values[0]:
        assert int(found.status) == Status.ILL_POSED and int(found.rank) < size
    if values[-1] > 1e-6 * values[0]:
        assert int(found.status) > 0 and int(found.rank) == size


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    scale=st.sampled_from((0.0, 1e-300, 1e-30, 1e-8, 1.0, 1e8, 1e60)),
    start=st.sampled_from((0.0, 1e-12, 1.0, 1e6)),
    width=st.sampled_from((0.0, 1e-9, 1.0, math.inf)),
    curved=st.booleans(),
)
def test_nothing_extreme_gives_a_nan_or_hangs(seed, scale, start, width, curved):
    generator = torch.Generator().manual_seed(seed)
    measured = scale * torch.randn(5, 40, generator=generator, dtype=torch.float64)
    measured[1, ::3] = math.nan
    model = Decays(measured)
    lower = torch.full((3,), start).double() - width
    with np.errstate(all="ignore"):
        found = least_squares(
            model,
            torch.full((5, 3), start),
            lower,
            lower + 2 * width if math.isfinite(width) else INFINITE,
            curvature=model.curvature if curved else None,
            most=100,
        )
    assert not bool(found.parameters.isnan().any() | found.cost.isnan().any())
    assert not bool(found.covariance.isnan().any())
    assert bool((found.steps <= 100).all())
    first = Decays(measured)(torch.full((5, 3), start).double(), torch.arange(5))[0]
    before = first.square().nan_to_num(0.0, math.inf).sum(-1) / 2
    assert bool((found.cost <= before * (1 + 1e-12)).all())


def test_impossible_boxes_are_refused():
    model = Decays(torch.zeros(2, 40).double())
    for start, lower in ((math.nan, 0.0), (1.0, math.nan), (1.0, 3.0)):
        with pytest.raises(ValueError, match="Least-squares problem 0 starts at"):
            least_squares(model, torch.full((2, 3), start), torch.full((3,), lower), torch.full((3,), 2.0))
    empty = least_squares(model, torch.zeros(0, 3), torch.zeros(3), torch.ones(3))
    assert empty.parameters.shape == (0, 3) and empty.covariance.shape == (0, 3, 3)
