"""The physics of a table-tennis ball: flight with drag, Magnus force and spin decay, and its bounce.

Formulas are written over single components with arithmetic only, so that they serve both plain floats and batches of
tensors. The estimation calls them with tensors, and SciPy's solvers call them with floats a hundred thousand times.
Therefore `no_type_check` excludes them from the type checks that tests switch on. Units are metres, seconds and rad/s;
z points up, and y along the table.
"""

from dataclasses import dataclass
from typing import Annotated, Any, no_type_check

from pydantic import Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector = tuple[Any, Any, Any]
"""x, y and z, each a float or a tensor."""


@dataclass(frozen=True, kw_only=True)
class Constants:
    """Constants of a table-tennis ball and a table.

    If the simulator of the WAM laboratory has a constant, its default here is the simulator's value. This laboratory
    also published recorded flights.

    Attributes:
        gravity: acceleration of gravity, m/s².
        drag: k of the deceleration k |v| v, 1/m (Mülling et al. 2011, eq. 1).
        lift: m of the Magnus acceleration m ω × v, dimensionless: ρ A r c / (2 · mass) with the density ρ of air, the
            ball's cross-section A and radius r, and the lift coefficient c = 0.6.
        spin_decay: rate of the exponential decay of the spin ω, dω/dt = -`spin_decay` · ω, 1/s.
        restitution: upward speed after the bounce divided by downward speed before it.
        friction: Coulomb's coefficient of friction between ball and table.
        radius: radius of the ball, m.
        surface: height of the table, m, in the frame of the recordings.
        near: y at which the table begins, m. Before `near` and beyond `far` there is no bounce.
        far: y at which the table ends, m.
    """

    gravity: Positive = 9.802
    drag: NotNegative = 0.1414
    lift: NotNegative = 0.0033
    spin_decay: NotNegative = 0.2
    restitution: Annotated[float, Field(gt=0, le=1)] = 0.88
    friction: NotNegative = 0.1
    radius: Positive = 0.02
    surface: Finite = -0.95
    near: Finite = -3.9
    far: Finite = -1.1

    @property
    def touching(self) -> float:
        """Height of the ball's centre when it touches the table, m."""
        return self.surface + self.radius


@no_type_check
def acceleration(velocity: Vector, spin: Vector, constants: Constants) -> Vector:
    """Return the acceleration g - k |v| v + m ω × v of a flying ball, m/s².

    v is the velocity, ω the spin, g gravity, k the drag and m the lift of `Constants` (Mülling, Kober & Peters 2011,
    eq. 1, with Magnus's term).
    """
    (u, v, w), (a, b, c) = velocity, spin
    # The small constant keeps the root differentiable where the ball rests.
    drag = constants.drag * (u * u + v * v + w * w + 1e-24) ** 0.5
    lift = constants.lift
    return (
        lift * (b * w - c * v) - drag * u,
        lift * (c * u - a * w) - drag * v,
        lift * (a * v - b * u) - drag * w - constants.gravity,
    )


@no_type_check
def slip(velocity: Vector, spin: Vector, radius: float) -> tuple[Any, Any]:
    """Return the velocity of the ball's lowest point along the table, m/s.

    It is the horizontal part of v + ω × (-r ẑ), for the velocity v, the spin ω and the radius r; ẑ points up.
    """
    return velocity[0] - radius * spin[1], velocity[1] + radius * spin[0]


@no_type_check
def bounce(velocity: Vector, spin: Vector, constants: Constants) -> tuple[Vector, Vector]:
    """Return velocity and spin after an instantaneous bounce.

    The model follows Nakashima et al. (2010), for a hollow sphere, I = 2/3 m r². The table's friction stops the slip
    (the velocity of the contact point) if it can: this takes an impulse of 2/5 of the slip per unit of mass. Friction
    can give at most μ times the upward impulse (1 + e) |w|, where w is the vertical velocity before the bounce, e the
    restitution and μ the friction of `Constants`. If this is not enough, the ball goes on sliding.
    """
    u, v, w = velocity
    along, across = slip(velocity, spin, constants.radius)
    speed = (along * along + across * across + 1e-24) ** 0.5
    up = (1 + constants.restitution) * abs(w)
    most = constants.friction * up / speed
    share = (most + 0.4 - abs(most - 0.4)) / 2  # min(most, 0.4), for floats and tensors alike
    push, pull = -share * along, -share * across
    turn = 1.5 / constants.radius
    after = (u + push, v + pull, constants.restitution * abs(w))
    return after, (spin[0] + turn * pull, spin[1] - turn * push, spin[2])
