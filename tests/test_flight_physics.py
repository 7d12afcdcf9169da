"""Physics of a ball, compared with closed forms, and many flights at once, compared with SciPy's solvers for each
flight."""

import math

import numpy as np
import pytest
import torch

from framework.flights.physics import Constants, acceleration, bounce, slip
from framework.flights.trajectories import simulate, simulate_with_jacobian
from framework.testing.flights import START
from plugins.data.table_tennis.solvers import flight

TIMES = 0.016 * np.arange(60)


def starts(count: int) -> np.ndarray:
    """Return random starts of flights with spins in all directions; most of these flights land on the table."""
    random = np.random.default_rng(0)
    return START + random.normal(size=(count, 9)) * [0.2, 0.1, 0.1, 0.5, 0.5, 0.4, 80, 80, 80]


def test_a_fall_with_drag_has_its_closed_form() -> None:
    found = simulate(
        torch.tensor([[0.0, 0, 50, 0, 0, 0, 0, 0, 0]]).double(),
        torch.from_numpy(TIMES)[None],
        Constants(),
    )[0]
    rate = math.sqrt(9.802 * 0.1414)
    np.testing.assert_allclose(found[:, 5], -9.802 / rate * np.tanh(rate * TIMES), atol=1e-8)
    np.testing.assert_allclose(found[:, 2], 50 - np.log(np.cosh(rate * TIMES)) / 0.1414, atol=1e-8)


def test_spin_turns_a_flight_about_its_axis() -> None:
    """The Magnus force ω × v presses a ball with topspin down, and does no work."""
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
        after, turned = bounce(velocity, spin, constants)
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
    found = simulate(torch.from_numpy(states), torch.from_numpy(moments), Constants())
    landed = 0
    for state, moment, mine in zip(states, moments, found.numpy(), strict=True):
        path = flight(state, moment, Constants(), method="DOP853", tolerance=1e-12)
        landed += len(path.contacts)
        np.testing.assert_allclose(mine[:, :3], path.states[:, :3], atol=1e-6)
    assert landed >= 8
    places, slopes = simulate_with_jacobian(torch.from_numpy(states), torch.from_numpy(moments), Constants())
    torch.testing.assert_close(places, found[..., :3])
    for number, size in ((2, 1e-6), (4, 1e-6), (7, 1e-4)):
        shift = torch.zeros(9).double()
        shift[number] = size
        two = [
            simulate(torch.from_numpy(states) + sign * shift, torch.from_numpy(moments), Constants())
            for sign in (1, -1)
        ]
        change = (two[0] - two[1])[..., :3] / (2 * size)
        torch.testing.assert_close(slopes[..., number], change, rtol=1e-5, atol=1e-6)


def test_a_ball_comes_to_rest_and_falls_off_the_table() -> None:
    still = torch.tensor([[0.0, -2.0, -0.92, 0, 0, 0, 0, 0, 0]]).double()
    times = torch.arange(0, 4, 0.02, dtype=torch.float64)[None]
    ended = simulate(still, times, Constants())[0, -1]
    assert ended[2] == pytest.approx(-0.93, abs=1e-4)
    rolling = torch.tensor([[0.0, -1.5, -0.93, 0, 1.0, 0, 0, 0, 0]]).double()
    assert simulate(rolling, times[:, :100], Constants())[0, -1, 2] < -1.5
    path = flight(still[0].numpy(), times[0, ::20].numpy(), Constants(), method="DOP853")
    assert abs(path.states[-1, 2] + 0.93) < 1e-5 and np.isfinite(path.states).all()
