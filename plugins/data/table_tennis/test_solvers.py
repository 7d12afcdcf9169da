"""Tests of solvers of a single flight against each other, and against 50 digits on stiff contact."""

import math

import numpy as np
import pytest

from framework.flights.physics import Constants
from plugins.data.table_tennis.closed_form import landing
from plugins.data.table_tennis.contact import Spring
from plugins.data.table_tennis.solvers import METHODS, SolverGaveUp, flight

BARE = Constants(drag=0.0, lift=0.0, spin_decay=0.0, friction=0.0, near=-100.0, far=100.0)


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
    """Check that with ζ the spring returns exp(-ζ/√(1 - ζ²) (π - atan2(2 ζ √(1 - ζ²), 1 - 2 ζ²))) of the speed."""
    zeta = 0.04
    turn = math.sqrt(1 - zeta**2)
    given_back = math.exp(-zeta / turn * (math.pi - math.atan2(2 * zeta * turn, 1 - 2 * zeta**2)))
    assert given_back == pytest.approx(0.88, abs=0.01)
    times = np.linspace(0, 0.3, 5)
    state = np.array([0, 0, BARE.touching + 0.1, 0.5, 0.5, -1, 0, 0, 0])
    hard = flight(state, times, BARE, Spring(frequency=1e7, damping=zeta), method=method)  # type: ignore[arg-type]
    short = flight(state, times, Constants(**{**vars(BARE), "restitution": given_back}), method=method)  # type: ignore[arg-type]
    np.testing.assert_allclose(hard.states[:, :6], short.states[:, :6], atol=1e-5)
