"""One flight by SciPy's explicit and implicit solvers, with dense output, events, bounded steps and stiff contact."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.integrate import BDF, DOP853, LSODA, RK45, OdeSolver, Radau
from scipy.optimize import brentq

from framework.errors import UserError
from framework.flights.physics import Constants, acceleration, bounce
from plugins.data.table_tennis.contact import Spring, pressed, push

Method = Literal["RK45", "DOP853", "LSODA", "BDF", "Radau"]
METHODS: dict[str, Callable[..., OdeSolver]] = {
    "RK45": RK45, "DOP853": DOP853, "LSODA": LSODA, "BDF": BDF, "Radau": Radau,
}  # fmt: skip
EXPLICIT = ("RK45", "DOP853")
MOST_PHASES = 1000
"""Largest number of phases, of free flight and of contact, in one flight."""
REST = 1e-6
"""Speed upwards, m/s, below which a ball without a spring comes to rest instead of bouncing."""


class SolverGaveUp(UserError):
    """Error of a solver that did not reach the end; the message says where, after how much, and what to choose."""


class Path(NamedTuple):
    """Solution of one flight.

    Attributes:
        times: requested times, s.
        states: (time, 9): position, velocity, spin.
        contacts: times at which the ball came down on the table, s.
        evaluations: number of evaluations of the derivative.
        steps: number of steps of the solver.
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
    """Return the flight from a state at `times[0]`, at all times, which increase.

    A flight is a sequence of phases, each with a smooth right-hand side: in the air; in the table and pushed; in the
    table and no longer pushed ("loose"); at rest on it; fallen beside it. The border between two phases is an event,
    which is located on the solver's dense output. Without a spring a bounce takes no time (`bounce`), and bouncing
    ends at `REST`.

    Args:
        start: position, velocity and spin at `times[0]`.
        times: increasing times, s.
        constants: constants of the ball and the table.
        spring: the table as a spring and a damper; None for a bounce that takes no time.
        method: SciPy's solver.
        tolerance: relative tolerance; the absolute one is as much of a metre, of a metre per second, and of 100 rad/s.
        most_steps: largest number of steps in all phases together.

    Raises:
        SolverGaveUp: the steps do not suffice, or become smaller than rounding.
    """
    walk = _Walk(times, constants, spring, method, tolerance, most_steps)
    level = np.array(
        [0, 0, constants.touching, *[0] * 6]
    )  # heights from here on are above the touching ball's
    state, time, phase = start - level, float(times[0]), "air"
    if spring is not None and state[2] < 0:
        phase = "pushed" if push(state[2], state[5], spring) > 0 else "loose"
    for _ in range(MOST_PHASES):
        time, state, phase = walk.phase(time, state, phase)
        if time >= times[-1]:
            break
    else:
        raise walk.gave_up(time, f"{MOST_PHASES} bounces")
    return Path(times, walk.states + level, walk.contacts, walk.evaluations, walk.steps)


class _Walk:
    """State of one integration over its phases."""

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
        """Integrate until an event or the end, and return the time, the state and the phase that follows."""
        # time counts from the beginning of the phase: in the time of the flight, a contact of 1e-8 s has no digits left
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
                raise self.gave_up(
                    time + solver.t, f"{self.steps} steps ({message or 'the step became too small'})"
                )
            if not np.isfinite(solver.y).all():
                raise self.gave_up(time + solver.t, f"{self.steps} steps: the state is no longer finite")
            dense = solver.dense_output()
            last = float(solver.t_old if solver.t_old is not None else 0.0)
            until = self._crossing(dense, event, last, float(solver.t), armed)
            stop = float(solver.t) if until is None else until
            here = (times >= last) & (times <= stop)
            if here.any():
                self.states[here] = dense(times[here]).T
            if until is not None:
                return time + until, *self._after(time + until, dense(until), phase)
            armed = armed or bool(event(solver.y) > 0)
            if solver.status == "finished":
                return float(self.times[-1]), solver.y, phase
            if self.steps >= self.most_steps:
                raise self.gave_up(time + float(solver.t), f"{self.steps} steps")

    def gave_up(self, time: float, what: str) -> SolverGaveUp:
        kind = "explicit" if self.method in EXPLICIT else "implicit"
        other = "an implicit method (Radau, BDF)" if kind == "explicit" else "a larger tolerance"
        return SolverGaveUp(
            f"{self.method}, an {kind} method, gave up on a flight at {time:.6g} s of {float(self.times[-1]):g} s "
            f"after {what}; wanted the end of the flight. Choose {other}, more steps, or contact=bounce."
        )

    def _solver(self, state: NDArray[np.float64], end: float, phase: str) -> OdeSolver:
        """Return a solver whose error scale fits this phase, and whose first step cannot pass over all of the phase.

        The height of a ball pressed into a hard table is measured in g/Ω², that of a small hop in the hop's height.
        Measured in metres it would be lost in the tolerance, and the ball might come out below the table.
        """
        gravity, (height, climb) = self.constants.gravity, state[[2, 5]]
        first, tall, fast = np.inf, 1.0, 1.0
        if phase in ("pushed", "loose") and self.spring is not None:
            first = 0.01 / self.spring.frequency
            tall, fast = gravity / self.spring.frequency**2, gravity / self.spring.frequency
        if phase == "loose" and climb > 0:
            first = min(first, max(0.1 * -height / climb, 1e-3 * first))
        elif phase == "air" and climb > 0:
            hop = 2 * climb / gravity
            first, fast = 0.1 * hop, min(1.0, climb)
            tall = min(1.0, height + climb * hop)
        scale = np.array([1.0, 1.0, tall, 1.0, 1.0, fast, 100.0, 100.0, 100.0])
        return METHODS[self.method](
            self._rate(phase), 0.0, state, end, rtol=max(self.tolerance, 3e-14), atol=self.tolerance * scale,
            first_step=min(first, end) if np.isfinite(first) else None,
        )  # fmt: skip

    def _rate(self, phase: str) -> Callable[[float, NDArray[np.float64]], NDArray[np.float64]]:
        constants, spring = self.constants, self.spring

        @no_type_check
        def rate(_: float, state: NDArray[np.float64]) -> NDArray[np.float64]:
            _, _, z, u, v, w, a, b, c = state.tolist()
            faster = acceleration((u, v, w), (a, b, c), constants)
            turn = (0.0, 0.0, 0.0)
            if phase == "pushed" and spring is not None:
                up = push(z, w, spring)
                more, turn = pressed((u, v, w), (a, b, c), up, constants, spring)
                faster = (faster[0] + more[0], faster[1] + more[1], faster[2] + more[2])
            elif phase == "rest":
                w, faster = 0.0, (faster[0], faster[1], 0.0)
            decay = constants.spin_decay
            return np.array([u, v, w, *faster, turn[0] - decay * a, turn[1] - decay * b, turn[2] - decay * c])

        return rate

    def _event(self, phase: str) -> Callable[[NDArray[np.float64]], float]:
        """Return a function of the state that falls through 0 where the phase ends."""
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
        """Return where the event falls through 0 within a step, searched at eight places; None if it does not."""
        places = np.linspace(start, end, 9)
        values = [event(dense(place)) for place in places]
        for left, right, one, other in zip(places[:-1], places[1:], values[:-1], values[1:], strict=True):
            armed = armed or one > 0
            if armed and one > 0 >= other:
                rounding = 4 * np.finfo(float).eps
                found: Any = brentq(lambda at: event(dense(at)), left, right, xtol=1e-300, rtol=rounding)
                return float(found)
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
