"""Contact of a ball with a table that is a spring and a damper, for the solvers of a single flight."""

from dataclasses import dataclass
from typing import Any, no_type_check

from framework.flights.physics import Constants, NotNegative, Positive, Vector, slip


@dataclass(frozen=True, kw_only=True)
class Spring:
    """Spring and damper that model the table, so that a contact takes a short time instead of no time.

    While the ball is inside the table, the table pushes it up. The push per unit of mass is
    N = max(0, Ω² p + 2 ζ Ω p'), where p is the depth of the ball inside the table. The equation of the height then has
    the eigenvalues Ω (-ζ ± √(ζ² - 1)). With an Ω of 1e8/s the contact is 1e8 times as fast as a flight of one second.

    Attributes:
        frequency: Ω, 1/s.
        damping: ζ; at 1 the contact is critically damped.
        grip: Slip, m/s, below which friction is less than Coulomb friction, so that friction changes its sign without a
            jump.
    """

    frequency: Positive = 3000.0
    damping: NotNegative = 0.04
    grip: Positive = 0.01


@no_type_check
def push(height: Any, climb: Any, spring: Spring) -> Any:
    """Return the upward push per mass on a ball that is inside the table, m/s², before it is clipped at 0.

    Args:
        height: Height of the ball above the height at which it touches the table, m; negative inside the table.
        climb: Upward velocity of the ball, m/s.
        spring: Frequency and damping of the table.
    """
    return -(spring.frequency**2) * height - 2 * spring.damping * spring.frequency * climb


@no_type_check
def contact_rates(
    velocity: Vector, spin: Vector, up: Any, constants: Constants, spring: Spring
) -> tuple[Vector, Vector]:
    """Return the rates of change of velocity, m/s², and of spin, rad/s², caused by an upward push and its friction.

    Args:
        velocity: Velocity of the ball, m/s.
        spin: Spin of the ball, rad/s.
        up: Upward push per mass, m/s².
        constants: Constants of the ball and the table.
        spring: Table, which pushes the ball back like a spring.
    """
    along, across = slip(velocity, spin, constants.radius)
    share = constants.friction * up / (along * along + across * across + spring.grip**2) ** 0.5
    push_x, push_y = -share * along, -share * across
    spin_factor = 1.5 / constants.radius
    return (push_x, push_y, up), (spin_factor * push_y, -spin_factor * push_x, 0.0)
