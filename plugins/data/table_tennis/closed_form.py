"""Bouncing on a spring and damper in closed form, with 50 digits: the reference for the accuracy of the solvers.

Without air and friction, the height of the ball over time is a parabola in the air, and a damped oscillation while the
table pushes. Each phase ends at a root of its formula, so nothing is integrated numerically.
"""

from collections.abc import Callable
from typing import Any

import mpmath

from framework.flights.physics import Constants
from plugins.data.table_tennis.contact import Spring

DIGITS = 50
Motion = Callable[[Any], tuple[Any, Any]]
"""Function that returns height and upward velocity of the ball for a time since the start of a phase, seconds.

The height is 0 where the ball touches the table.
"""


def landing(
    height: float, climb: float, times: list[float], constants: Constants, spring: Spring
) -> list[float]:
    """Return the heights of a ball that is released above the table at time 0.

    All heights are in metres above the height at which the ball touches the table.

    Args:
        height: Height at time 0.
        climb: Upward velocity at time 0, m/s.
        times: Increasing times, s, at which heights are returned.
        constants: Constants of the ball and the table.
        spring: Frequency and damping of the table.
    """
    with mpmath.workdps(DIGITS):
        fall, rate, damping = map(mpmath.mpf, (constants.gravity, spring.frequency, spring.damping))
        heights: list[float] = []
        begin, z, speed = mpmath.mpf(0), mpmath.mpf(height), mpmath.mpf(climb)
        pushed = False
        while len(heights) < len(times):
            if pushed:
                motion = _damped_oscillation(z, speed, fall, rate, damping)
                remaining = mpmath.mpf(times[-1]) - begin
                length = _first_root(lambda t, m=motion: _push(*m(t), rate, damping), 1 / rate, remaining)
            else:
                motion = _free_fall(z, speed, fall)
                inside = z < 0
                until_landing = (speed + mpmath.sqrt(abs(speed**2 + 2 * fall * z))) / fall
                length = _end_of_loose(z, speed, fall, rate, damping) if inside else until_landing
            end = mpmath.inf if length is None else begin + length
            while len(heights) < len(times) and mpmath.mpf(times[len(heights)]) <= end:
                heights.append(float(motion(mpmath.mpf(times[len(heights)]) - begin)[0]))
            if length is None:
                break
            z, speed = motion(length)
            begin = end
            if not pushed and abs(z) < mpmath.mpf(10) ** (-DIGITS // 2):
                z = mpmath.mpf(0)
                pushed = speed < 0
            else:
                pushed = not pushed
        return heights


def _free_fall(z: Any, speed: Any, fall: Any) -> Motion:
    return lambda t: (z + speed * t - fall * t**2 / 2, speed - fall * t)


def _damped_oscillation(z: Any, speed: Any, fall: Any, rate: Any, damping: Any) -> Motion:
    """Return the motion under z'' = -Ω² z - 2 ζ Ω z' - g, an oscillation about -g/Ω² that decays.

    Args:
        z: Height at time 0, m.
        speed: Upward velocity z' at time 0, m/s.
        fall: g, m/s².
        rate: Ω, 1/s.
        damping: ζ, at most 1.
    """
    rest = -fall / rate**2
    first = z - rest

    def critical(t: Any) -> tuple[Any, Any]:
        slope = speed + rate * first
        size = mpmath.exp(-rate * t)
        return rest + size * (first + slope * t), size * (slope - rate * (first + slope * t))

    def underdamped(t: Any) -> tuple[Any, Any]:
        frequency = rate * mpmath.sqrt(1 - damping**2)
        slope = (speed + damping * rate * first) / frequency
        size, angle = mpmath.exp(-damping * rate * t), frequency * t
        cosine, sine = mpmath.cos(angle), mpmath.sin(angle)
        swing = first * cosine + slope * sine
        velocity = size * (frequency * (slope * cosine - first * sine) - damping * rate * swing)
        return rest + size * swing, velocity

    return critical if damping == 1 else underdamped


def _push(z: Any, speed: Any, rate: Any, damping: Any) -> Any:
    """Return the upward push of the table per unit of mass, -Ω² z - 2 ζ Ω z', before it is clipped at 0.

    The arguments are those of `_damped_oscillation`.
    """
    return -(rate**2) * z - 2 * damping * rate * speed


def _first_root(value: Callable[[Any], Any], scale: Any, longest: Any) -> Any | None:
    """Return the first time at which a function of time that starts above 0 falls to 0.

    The search takes steps of `scale`/64. The result is None if there is no root within `longest` or within 60 scales.
    """
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


def _end_of_loose(z: Any, speed: Any, fall: Any, rate: Any, damping: Any) -> Any:
    """Return the time at which a ball that is inside the table, but not pushed by it, leaves it or is pushed again.

    The arguments are those of `_damped_oscillation`. At time 0 the ball is in the phase "loose" (see `solvers.flight`).
    """
    discriminant = speed**2 + 2 * fall * z
    leaves = (speed - mpmath.sqrt(discriminant)) / fall if discriminant >= 0 else None
    # along the parabola, Ω² z + 2 ζ Ω z' = 0 is a quadratic equation in t
    a, b, c = -fall / 2, speed - 2 * damping / rate * fall, z + 2 * damping / rate * speed
    root = mpmath.sqrt(b**2 - 4 * a * c)
    pushed_again = (-b - root) / (2 * a)
    pushed_again = pushed_again if pushed_again > mpmath.mpf(10) ** (-DIGITS // 2) / rate else None
    return min(time for time in (leaves, pushed_again) if time is not None)
