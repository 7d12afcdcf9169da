"""Tests of the solvers of a single flight, compared with each other and with a 50-digit reference on stiff contact."""

import math

import numpy as np
import pytest

from framework.flights.physics import Constants
from plugins.data.table_tennis.closed_form import landing
from plugins.data.table_tennis.contact import Spring
from plugins.data.table_tennis.solvers import METHODS, SolverGaveUp, flight

BARE = Constants(drag=0.0, lift=0.0, spin_decay=0.0, friction=0.0, near=-100.0, far=100.0)


@pytest.mark.parametrize("frequency, damping", [(1e2, 1.0), (1e5, 0.04), (1e8, 0.04), (1e8, 1.0)])
def test_implicit_solvers_are_accurate_on_any_stiff_contact(frequency: float, damping: float) -> None:
    spring = Spring(frequency=frequency, damping=damping)
    state = np.array([0, 0, BARE.touching + 0.1, 0.5, 0.5, 0.0, 0, 0, 0])
    times = np.linspace(0, 1, 26)
    expected = landing(0.1, 0.0, times.tolist(), BARE, spring)
    for method in ("Radau", "BDF", "LSODA"):
        path = flight(state, times, BARE, spring, method=method, tolerance=1e-8)
        np.testing.assert_allclose(path.states[:, 2] - BARE.touching, expected, atol=2e-6)
        assert path.steps < 2000


def test_explicit_solvers_need_many_steps_and_then_give_up() -> None:
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
def test_a_bounce_on_a_hard_spring_equals_an_instantaneous_bounce(method: str) -> None:
    """Check that the spring's restitution is exp(-ζ/√(1 - ζ²) (π - atan2(2 ζ √(1 - ζ²), 1 - 2 ζ²)))."""
    zeta = 0.04
    root = math.sqrt(1 - zeta**2)
    restitution = math.exp(-zeta / root * (math.pi - math.atan2(2 * zeta * root, 1 - 2 * zeta**2)))
    assert restitution == pytest.approx(0.88, abs=0.01)
    times = np.linspace(0, 0.3, 5)
    state = np.array([0, 0, BARE.touching + 0.1, 0.5, 0.5, -1, 0, 0, 0])
    hard = flight(state, times, BARE, Spring(frequency=1e7, damping=zeta), method=method)  # type: ignore[arg-type]
    constants = Constants(**{**vars(BARE), "restitution": restitution})
    instantaneous = flight(state, times, constants, method=method)  # type: ignore[arg-type]
    np.testing.assert_allclose(hard.states[:, :6], instantaneous.states[:, :6], atol=1e-5)
