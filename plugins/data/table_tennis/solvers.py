"""Integration of one flight by SciPy's explicit and implicit solvers, with events and stiff contact."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.integrate import BDF, DOP853, LSODA, RK45, OdeSolver, Radau
from scipy.optimize import brentq

from framework.errors import UserError
from framework.flights.physics import Constants, acceleration, bounce
from plugins.data.table_tennis.contact import Spring, contact_rates, push

Method = Literal["RK45", "DOP853", "LSODA", "BDF", "Radau"]
METHODS: dict[str, Callable[..., OdeSolver]] = {
    "RK45": RK45, "DOP853": DOP853, "LSODA": LSODA, "BDF": BDF, "Radau": Radau,
}  # fmt: skip
EXPLICIT = ("RK45", "DOP853")
MOST_PHASES = 1000
"""Largest number of phases, of free flight and of contact, in one flight."""
REST = 1e-6
"""Upward speed, m/s, below which a ball comes to rest instead of bouncing, if the table is not a spring."""


class SolverGaveUp(UserError):
    """Error of a solver that did not reach the end of a flight."""


class Path(NamedTuple):
    """Solution of one flight.

    Attributes:
        times: Requested times, s.
        states: Position, velocity and spin at these times, (time, 9).
        contacts: Times at which the ball came down on the table, s.
        evaluations: Number of evaluations of the derivative.
        steps: Number of steps of the solver.
    """

    times: Float[np.ndarray, "time"]
    states: Float[np.ndarray, "time 9"]
    contacts: list[float]
    evaluations: int
    steps: int


def flight(
    start: Float[np.ndarray, "9"],
    times: Float[np.ndarray, "time"],
    constants: Constants,
    spring: Spring | None = None,
    *,
    method: Method = "Radau",
    tolerance: float = 1e-8,
    most_steps: int = 20_000,
) -> Path:
    """Return the flight that begins with the state `start` at `times[0]`, at all times.

    A flight is a sequence of phases, in each of which the derivative of the state is smooth: "air"; "pushed" (inside
    the table and pushed by it); "loose" (inside the table but not pushed); "rest" (at rest on the table); "below"
    (fallen beside the table). A phase ends at an event, which is located on the solver's dense output. Without a spring
    a bounce takes no time (`bounce`), and the ball comes to rest after a bounce with an upward speed of at most `REST`.

    Args:
        start: Position, velocity and spin at `times[0]`.
        times: Increasing times, s.
        constants: Constants of the ball and the table.
        spring: The table as a spring and a damper; None for a bounce that takes no time.
        method: SciPy's solver.
        tolerance: Relative tolerance; the absolute tolerance is `tolerance` times 1 m, 1 m/s and 100 rad/s.
        most_steps: Largest number of steps in all phases together.

    Raises:
        SolverGaveUp: `most_steps` steps or MOST_PHASES phases do not suffice, a step becomes smaller than rounding
            errors, or the state is no longer finite.
    """
    walk = _Walk(times, constants, spring, method, tolerance, most_steps)
    # inside the walk, the height is 0 where the ball touches the table
    level = np.array([0, 0, constants.touching, *[0] * 6])
    state, time, phase = start - level, float(times[0]), "air"
    if spring is not None and state[2] < 0:
        phase = "pushed" if push(state[2], state[5], spring) > 0 else "loose"
    for _ in range(MOST_PHASES):
        time, state, phase = walk.phase(time, state, phase)
        if time >= times[-1]:
            break
    else:
        raise walk.failure(time, f"{MOST_PHASES} phases")
    return Path(times, walk.states + level, walk.contacts, walk.evaluations, walk.steps)


class _Walk:
    """Integration of one flight over its phases.

    It holds the states, the times of the contacts, and the numbers of steps and evaluations so far.
    """

    def __init__(
        self,
        times: NDArray[np.float64],
        constants: Constants,
        spring: Spring | None,
        method: Method,
        tolerance: float,
        most_steps: int,
    ) -> None:
        self.times, self.constants, self.spring = times, constants, spring
        self.method: Method = method
        self.tolerance, self.most_steps = tolerance, most_steps
        self.states = np.full((len(times), 9), np.nan)
        self.contacts: list[float] = []
        self.evaluations = self.steps = 0

    def phase(
        self, time: float, state: NDArray[np.float64], phase: str
    ) -> tuple[float, NDArray[np.float64], str]:
        """Integrate until an event or the end, and return the time, the state and the next phase."""
        # the solver's time starts at 0 in each phase, because a contact may last only 1e-8 s
        end = float(self.times[-1]) - time
        times = self.times - time
        event = self._event(phase)
        solver = self._solver(state, end, phase)
        armed = bool(event(state) > 0)
        while True:
            before = solver.nfev
            message = solver.step()
            self.evaluations += solver.nfev - before
            self.steps += 1
            if solver.status == "failed":
                raise self.failure(
                    time + solver.t, f"{self.steps} steps ({message or 'the step became too small'})"
                )
            if not np.isfinite(solver.y).all():
                raise self.failure(time + solver.t, f"{self.steps} steps (the state is no longer finite)")
            dense = solver.dense_output()
            last = float(solver.t_old if solver.t_old is not None else 0.0)
            until = self._crossing(dense, event, last, float(solver.t), armed)
            stop = float(solver.t) if until is None else until
            in_step = (times >= last) & (times <= stop)
            if in_step.any():
                self.states[in_step] = dense(times[in_step]).T
            if until is not None:
                return time + until, *self._after(time + until, dense(until), phase)
            armed = armed or bool(event(solver.y) > 0)
            if solver.status == "finished":
                return float(self.times[-1]), solver.y, phase
            if self.steps >= self.most_steps:
                raise self.failure(time + float(solver.t), f"{self.steps} steps")

    def failure(self, time: float, effort: str) -> SolverGaveUp:
        """Return the error of a solver that gave up at a time of the flight, after an effort such as "9 steps"."""
        kind = "explicit" if self.method in EXPLICIT else "implicit"
        other = "an implicit method (Radau, BDF)" if kind == "explicit" else "a larger tolerance"
        return SolverGaveUp(
            f"{self.method}, an {kind} method, gave up on a flight at {time:.6g} s of {float(self.times[-1]):g} s "
            f"after {effort}. Choose {other}, more steps, or contact=bounce."
        )

    def _solver(self, state: NDArray[np.float64], end: float, phase: str) -> OdeSolver:
        """Return a solver whose absolute tolerance fits this phase, and whose first step is shorter than the phase.

        The tolerance of the height is relative to g/Ω² while the ball is inside the table, and to the height of a hop
        that is lower than 1 m. With a tolerance relative to 1 m, the ball might leave the table on its lower side.
        """
        gravity, (height, climb) = self.constants.gravity, state[[2, 5]]
        first, height_scale, speed_scale = np.inf, 1.0, 1.0
        if phase in ("pushed", "loose") and self.spring is not None:
            first = 0.01 / self.spring.frequency
            height_scale, speed_scale = gravity / self.spring.frequency**2, gravity / self.spring.frequency
        if phase == "loose" and climb > 0:
            first = min(first, max(0.1 * -height / climb, 1e-3 * first))
        elif phase == "air" and climb > 0:
            duration = 2 * climb / gravity
            first, speed_scale = 0.1 * duration, min(1.0, climb)
            height_scale = min(1.0, height + climb * duration)
        scale = np.array([1.0, 1.0, height_scale, 1.0, 1.0, speed_scale, 100.0, 100.0, 100.0])
        return METHODS[self.method](
            self._rate(phase), 0.0, state, end, rtol=max(self.tolerance, 3e-14), atol=self.tolerance * scale,
            first_step=min(first, end) if np.isfinite(first) else None,
        )  # fmt: skip

    def _rate(self, phase: str) -> Callable[[float, NDArray[np.float64]], NDArray[np.float64]]:
        """Return the function from time and state to the derivative of the state in a phase."""
        constants, spring = self.constants, self.spring

        @no_type_check
        def rate(_: float, state: NDArray[np.float64]) -> NDArray[np.float64]:
            _, _, z, u, v, w, a, b, c = state.tolist()
            speeding = acceleration((u, v, w), (a, b, c), constants)
            spinning = (0.0, 0.0, 0.0)
            if phase == "pushed" and spring is not None:
                up = push(z, w, spring)
                pushing, spinning = contact_rates((u, v, w), (a, b, c), up, constants, spring)
                speeding = (speeding[0] + pushing[0], speeding[1] + pushing[1], speeding[2] + pushing[2])
            elif phase == "rest":
                w, speeding = 0.0, (speeding[0], speeding[1], 0.0)
            decay = constants.spin_decay
            spin_rate = (spinning[0] - decay * a, spinning[1] - decay * b, spinning[2] - decay * c)
            return np.array([u, v, w, *speeding, *spin_rate])

        return rate

    def _event(self, phase: str) -> Callable[[NDArray[np.float64]], float]:
        """Return a function of the state that falls through 0 when the phase ends."""
        spring = self.spring
        if phase == "air":
            return lambda state: float(state[2])
        if phase in ("rest", "below"):
            return lambda state: 1.0
        assert spring is not None
        if phase == "pushed":
            return lambda state: push(state[2], state[5], spring) / spring.frequency
        return lambda state: min(
            -spring.frequency * state[2], -push(state[2], state[5], spring) / spring.frequency
        )

    @no_type_check
    def _crossing(
        self, dense: Callable[..., NDArray[np.float64]], event: Callable[..., float], start: float, end: float,
        armed: bool,
    ) -> float | None:  # fmt: skip
        """Return the time at which the event falls through 0 within a step of the solver; None if it does not.

        Only a fall from above 0 counts. The step is divided into eight intervals, each of which is searched.

        Args:
            dense: function from time to state within the step.
            event: function of the state, from `_event`.
            start: start of the step, s.
            end: end of the step, s.
            armed: whether the event was above 0 earlier in this phase.
        """
        times = np.linspace(start, end, 9)
        values = [event(dense(time)) for time in times]
        for left, right, before, after in zip(times[:-1], times[1:], values[:-1], values[1:], strict=True):
            armed = armed or before > 0
            if armed and before > 0 >= after:
                rounding = 4 * np.finfo(float).eps
                root: Any = brentq(lambda time: event(dense(time)), left, right, xtol=1e-300, rtol=rounding)
                return float(root)
        return None

    def _after(self, time: float, state: NDArray[np.float64], phase: str) -> tuple[NDArray[np.float64], str]:
        """Return the state and the phase after an event."""
        constants, spring = self.constants, self.spring
        if phase == "pushed":
            return state, "loose"
        pushed_again = (
            spring is not None and push(state[2], state[5], spring) > spring.frequency**2 * state[2]
        )
        if phase == "loose" and pushed_again:
            return state, "pushed"
        state = state.copy()
        state[2] = 0.0
        if phase == "loose":
            return state, "air"
        if not constants.near < state[1] < constants.far:
            return state, "below"
        self.contacts.append(time)
        if spring is not None:
            return state, "pushed"
        x, y, z, u, v, w, a, b, c = state.tolist()
        (u, v, w), (a, b, c) = bounce((u, v, w), (a, b, c), constants)
        phase = "air" if w > REST else "rest"
        return np.array([x, y, z, u, v, w if phase == "air" else 0.0, a, b, c]), phase
