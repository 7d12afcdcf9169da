"""The ball's physics against closed forms, SciPy's solvers, and 50 digits on stiff contact."""

import math

import numpy as np
import pytest
import torch

from plugins.data.table_tennis.closed_form import landing
from plugins.data.table_tennis.flying import flown, flown_with_slopes
from plugins.data.table_tennis.physics import Constants, Spring, acceleration, bounced, slip
from plugins.data.table_tennis.solvers import METHODS, SolverGaveUp, flight

BARE = Constants(drag=0.0, lift=0.0, spin_decay=0.0, friction=0.0, near=-100.0, far=100.0)
START = np.array([0.8, -4.1, -0.62, -0.6, 6.2, 1.6, 20.0, -30.0, 10.0])
TIMES = 0.016 * np.arange(60)


def starts(count: int) -> np.ndarray:
    """With spins of every direction; most of them land."""
    random = np.random.default_rng(0)
    return START + random.normal(size=(count, 9)) * [0.2, 0.1, 0.1, 0.5, 0.5, 0.4, 80, 80, 80]


def test_a_fall_with_drag_has_its_closed_form() -> None:
    found = flown(
        torch.tensor([[0.0, 0, 50, 0, 0, 0, 0, 0, 0]]).double(),
        torch.from_numpy(TIMES)[None],
        Constants(),
    )[0]
    rate = math.sqrt(9.802 * 0.1414)
    np.testing.assert_allclose(found[:, 5], -9.802 / rate * np.tanh(rate * TIMES), atol=1e-8)
    np.testing.assert_allclose(found[:, 2], 50 - np.log(np.cosh(rate * TIMES)) / 0.1414, atol=1e-8)


def test_spin_turns_a_flight_about_its_axis() -> None:
    """ω × v: topspin of a ball that flies along y presses it down, and no spin does work."""
    constants = Constants(drag=0.0)
    down = acceleration((0.0, 5.0, 0.0), (-100.0, 0.0, 0.0), constants)
    assert down == pytest.approx((0, 0, -9.802 - 0.0033 * 500))
    velocity, spin = (1.0, 5.0, -2.0), (30.0, -70.0, 20.0)
    lift = np.add(acceleration(velocity, spin, constants), [0, 0, 9.802])
    np.testing.assert_allclose(lift, 0.0033 * np.cross(spin, velocity), rtol=1e-12)


@pytest.mark.parametrize("friction", [0.0, 0.05, 10.0])
def test_a_bounce_obeys_coulomb_and_makes_no_energy(friction: float) -> None:
    constants = Constants(friction=friction)
    for state in starts(40):
        velocity, spin = (*state[3:5], -3.0), tuple(state[6:])
        after, turned = bounced(velocity, spin, constants)
        assert after[2] == pytest.approx(0.88 * 3)
        impulse = np.subtract(after, velocity)
        before, left = slip(velocity, spin, 0.02), slip(after, turned, 0.02)
        assert np.hypot(*impulse[:2]) <= friction * impulse[2] * (1 + 1e-9)
        if friction == 10:
            np.testing.assert_allclose(left, 0, atol=1e-9)
        assert np.dot(before, left) >= -1e-9  # friction stops a slip and does not turn it
        # angular momentum about the point of contact: r × v + 2/3 r² ω, r upwards
        moments = [
            np.cross([0, 0, 0.02], v) + 2 / 3 * 0.02**2 * np.array(w)
            for v, w in ((velocity, spin), (after, turned))
        ]
        np.testing.assert_allclose(*moments, atol=1e-12)
        energies = [
            np.dot(v, v) + 2 / 3 * 0.02**2 * np.dot(w, w) for v, w in ((velocity, spin), (after, turned))
        ]
        assert energies[1] <= energies[0] * (1 + 1e-12)


def test_many_flights_at_once_are_scipys_one_by_one() -> None:
    states = starts(12)
    moments = np.sort(TIMES + np.random.default_rng(1).uniform(-0.004, 0.004, (12, 60)), 1)
    found = flown(torch.from_numpy(states), torch.from_numpy(moments), Constants())
    landed = 0
    for state, moment, mine in zip(states, moments, found.numpy(), strict=True):
        path = flight(state, moment, Constants(), method="DOP853", tolerance=1e-12)
        landed += len(path.contacts)
        np.testing.assert_allclose(mine[:, :3], path.states[:, :3], atol=1e-6)
    assert landed >= 8
    places, slopes = flown_with_slopes(torch.from_numpy(states), torch.from_numpy(moments), Constants())
    torch.testing.assert_close(places, found[..., :3])
    for number, size in ((2, 1e-6), (4, 1e-6), (7, 1e-4)):
        shift = torch.zeros(9).double()
        shift[number] = size
        two = [
            flown(torch.from_numpy(states) + sign * shift, torch.from_numpy(moments), Constants())
            for sign in (1, -1)
        ]
        change = (two[0] - two[1])[..., :3] / (2 * size)
        torch.testing.assert_close(slopes[..., number], change, rtol=1e-5, atol=1e-6)


def test_a_ball_comes_to_rest_and_falls_off_the_table() -> None:
    still = torch.tensor([[0.0, -2.0, -0.92, 0, 0, 0, 0, 0, 0]]).double()
    times = torch.arange(0, 4, 0.02, dtype=torch.float64)[None]
    ended = flown(still, times, Constants())[0, -1]
    assert ended[2] == pytest.approx(-0.93, abs=1e-4)
    rolling = torch.tensor([[0.0, -1.5, -0.93, 0, 1.0, 0, 0, 0, 0]]).double()
    assert flown(rolling, times[:, :100], Constants())[0, -1, 2] < -1.5
    path = flight(still[0].numpy(), times[0, ::20].numpy(), Constants(), method="DOP853")
    assert abs(path.states[-1, 2] + 0.93) < 1e-5 and np.isfinite(path.states).all()


@pytest.mark.parametrize("frequency, damping", [(1e2, 1.0), (1e5, 0.04), (1e8, 0.04), (1e8, 1.0)])
def test_implicit_solvers_hold_on_any_stiff_contact(frequency: float, damping: float) -> None:
    spring = Spring(frequency=frequency, damping=damping)
    state = np.array([0, 0, BARE.touching + 0.1, 0.5, 0.5, 0.0, 0, 0, 0])
    times = np.linspace(0, 1, 26)
    wanted = landing(0.1, 0.0, times.tolist(), BARE, spring)
    for method in ("Radau", "BDF", "LSODA"):
        path = flight(state, times, BARE, spring, method=method, tolerance=1e-8)
        np.testing.assert_allclose(path.states[:, 2] - BARE.touching, wanted, atol=2e-6)
        assert path.steps < 2000


def test_explicit_solvers_crawl_and_then_say_so() -> None:
    state, times = np.array([0, 0, BARE.touching + 0.1, 0.5, 0.5, 0.0, 0, 0, 0]), np.linspace(0, 1, 11)
    steps = [
        flight(state, times, BARE, Spring(frequency=rate, damping=1.0), method="DOP853").steps
        for rate in (1e2, 1e4)
    ]
    assert steps[1] > 20 * steps[0]
    for method in ("RK45", "DOP853"):
        with pytest.raises(
            SolverGaveUp, match=f"{method}, an explicit method, gave up.*after 500 steps.*Radau"
        ):
            flight(state, times, BARE, Spring(frequency=1e8, damping=1.0), method=method, most_steps=500)


@pytest.mark.parametrize("method", list(METHODS))
def test_a_hard_springs_bounce_is_the_one_in_no_time(method: str) -> None:
    """With ζ the spring gives back exp(-ζ/√(1 - ζ²) (π - atan2(2 ζ √(1 - ζ²), 1 - 2 ζ²))) of the speed."""
    zeta = 0.04
    turn = math.sqrt(1 - zeta**2)
    given_back = math.exp(-zeta / turn * (math.pi - math.atan2(2 * zeta * turn, 1 - 2 * zeta**2)))
    assert given_back == pytest.approx(0.88, abs=0.01)
    times = np.linspace(0, 0.3, 5)
    state = np.array([0, 0, BARE.touching + 0.1, 0.5, 0.5, -1, 0, 0, 0])
    hard = flight(state, times, BARE, Spring(frequency=1e7, damping=zeta), method=method)  # type: ignore[arg-type]
    short = flight(state, times, Constants(**{**vars(BARE), "restitution": given_back}), method=method)  # type: ignore[arg-type]
    np.testing.assert_allclose(hard.states[:, :6], short.states[:, :6], atol=1e-5)
