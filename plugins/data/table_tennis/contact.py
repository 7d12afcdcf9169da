"""Contact of a ball with a table that is a spring and a damper, for the solvers of a single flight."""

from dataclasses import dataclass
from typing import Any, no_type_check

from framework.flights.physics import Constants, NotNegative, Positive, Vector, slip


@dataclass(frozen=True, kw_only=True)
class Spring:
    """Spring and damper that model the table, so that a contact takes a short time instead of none.

    The ball is pushed up while it is inside the table and the push is upwards: N = max(0, Ω² p + 2 ζ Ω p'), where p is
    its depth inside the table. While it touches, the height has the eigenvalues Ω (-ζ ± √(ζ² - 1)): with an Ω of 1e8/s
    the contact is 1e8 times as fast as a flight of a second.

    Attributes:
        frequency: Ω, 1/s.
        damping: ζ; at 1 the contact is critically damped.
        grip: slip below which friction is less than Coulomb's, m/s, so that friction changes its sign without a jump.
    """

    frequency: Positive = 3000.0
    damping: NotNegative = 0.04
    grip: Positive = 0.01


@no_type_check
def push(height: Any, climb: Any, spring: Spring) -> Any:
    """Return the push upwards per mass on a ball that is inside the table, m/s², before it is clipped at 0.

    Args:
        height: height of its centre above the touching ball's, m; negative inside.
        climb: its velocity upwards, m/s.
        spring: frequency and damping of the table.
    """
    return -(spring.frequency**2) * height - 2 * spring.damping * spring.frequency * climb


@no_type_check
def pressed(
    velocity: Vector, spin: Vector, up: Any, constants: Constants, spring: Spring
) -> tuple[Vector, Vector]:
    """Return the change of velocity and of spin, per second, by a push upwards and the friction that comes with it."""
    along, across = slip(velocity, spin, constants.radius)
    share = constants.friction * up / (along * along + across * across + spring.grip**2) ** 0.5
    push_x, push_y = -share * along, -share * across
    turn = 1.5 / constants.radius
    return (push_x, push_y, up), (turn * push_y, -turn * push_x, 0.0)
