"""Landing on a spring and damper in closed form, with 50 digits: the reference for the accuracy of the solvers.

Without air and friction the height is a parabola in the air, and a damped oscillation about its rest height while the
table pushes. Each phase ends at a root of its own formula, so nothing is integrated.
"""

from collections.abc import Callable
from typing import Any

import mpmath

from framework.flights.physics import Constants
from plugins.data.table_tennis.contact import Spring

DIGITS = 50
Motion = Callable[[Any], tuple[Any, Any]]
"""Function from seconds since the phase began to height above the touching ball's, and velocity upwards."""


def landing(
    height: float, climb: float, times: list[float], constants: Constants, spring: Spring
) -> list[float]:
    """Return heights above the touching ball's, m, at rising times, s, of a ball released above the table at time 0.

    Args:
        height: height above the touching ball's at time 0, m.
        climb: velocity upwards at time 0, m/s.
        times: rising times, s.
        constants: constants of the ball and the table.
        spring: frequency and damping of the table.
    """
    with mpmath.workdps(DIGITS):
        fall, rate, damping = map(mpmath.mpf, (constants.gravity, spring.frequency, spring.damping))
        found: list[float] = []
        begin, place, speed = mpmath.mpf(0), mpmath.mpf(height), mpmath.mpf(climb)
        pushed = False
        while len(found) < len(times):
            if pushed:
                motion = _pressed(place, speed, fall, rate, damping)
                left = mpmath.mpf(times[-1]) - begin
                length = _until(lambda t, m=motion: _push(*m(t), rate, damping), 1 / rate, left)
            else:
                motion = _thrown(place, speed, fall)
                inside = place < 0
                whole = (speed + mpmath.sqrt(abs(speed**2 + 2 * fall * place))) / fall
                length = _out(place, speed, fall, rate, damping) if inside else whole
            end = mpmath.inf if length is None else begin + length
            while len(found) < len(times) and mpmath.mpf(times[len(found)]) <= end:
                found.append(float(motion(mpmath.mpf(times[len(found)]) - begin)[0]))
            if length is None:
                break
            place, speed = motion(length)
            begin = end
            if not pushed and abs(place) < mpmath.mpf(10) ** (-DIGITS // 2):
                place = mpmath.mpf(0)
                pushed = speed < 0
            else:
                pushed = not pushed
        return found


def _thrown(place: Any, speed: Any, fall: Any) -> Motion:
    return lambda t: (place + speed * t - fall * t**2 / 2, speed - fall * t)


def _pressed(place: Any, speed: Any, fall: Any, rate: Any, damping: Any) -> Motion:
    """Return the motion under z'' = -Ω² z - 2 ζ Ω z' - g, about its rest height at -g/Ω²."""
    rest = -fall / rate**2
    first = place - rest

    def critical(t: Any) -> tuple[Any, Any]:
        slope = speed + rate * first
        size = mpmath.exp(-rate * t)
        return rest + size * (first + slope * t), size * (slope - rate * (first + slope * t))

    def swinging(t: Any) -> tuple[Any, Any]:
        turn = rate * mpmath.sqrt(1 - damping**2)
        slope = (speed + damping * rate * first) / turn
        size, cosine, sine = mpmath.exp(-damping * rate * t), mpmath.cos(turn * t), mpmath.sin(turn * t)
        swing = first * cosine + slope * sine
        return rest + size * swing, size * (turn * (slope * cosine - first * sine) - damping * rate * swing)

    return critical if damping == 1 else swinging


def _push(place: Any, speed: Any, rate: Any, damping: Any) -> Any:
    return -(rate**2) * place - 2 * damping * rate * speed


def _until(value: Callable[[Any], Any], scale: Any, longest: Any) -> Any | None:
    """Return the first time at which a value that starts above 0 falls to 0; None if not by `longest` or 60 scales."""
    step = scale / 64
    before, number = step / 2**20, 0
    while number < 60 * 64:
        after = before + step
        if value(after) <= 0:
            tiny = mpmath.mpf(10) ** (-2 * DIGITS)
            return mpmath.findroot(value, (before, after), solver="anderson", tol=tiny, verify=False)
        if after > longest:
            return None
        before, number = after, number + 1
    return None


def _out(place: Any, speed: Any, fall: Any, rate: Any, damping: Any) -> Any:
    """Return when a ball that is inside the table and not pushed leaves it or is pushed again, whichever is first."""
    under = speed**2 + 2 * fall * place
    leaves = (speed - mpmath.sqrt(under)) / fall if under >= 0 else None
    # Ω² z + 2 ζ Ω z' = 0 along the parabola: a quadratic in t
    a, b, c = -fall / 2, speed - 2 * damping / rate * fall, place + 2 * damping / rate * speed
    root = mpmath.sqrt(b**2 - 4 * a * c)
    again = (-b - root) / (2 * a)
    again = again if again > mpmath.mpf(10) ** (-DIGITS // 2) / rate else None
    return min(one for one in (leaves, again) if one is not None)
