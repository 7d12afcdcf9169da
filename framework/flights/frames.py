"""What models read of a flight, frame by frame, and what they predict: x, y and z at one time after the other."""

from framework.errors import ConfigError

PARTS = ("time", "x", "y", "z", "seen")
"""Numbers that are read of each frame: seconds from now (not above 0), metres, and 1 where there is a frame, 0 where it
is missing; the other numbers of a missing frame are 0."""
GRAVITY = 9.81
"""Acceleration of a parabola between or behind frames, m/s²."""
AXES = "xyz"
MOST_NAMES = 10
"""Number of names that the message about a wrong target lists."""


def future_names(frames: int, step: float) -> tuple[str, ...]:
    """Return the names of the numbers that are predicted, frame by frame: "x_16ms", in metres.

    Args:
        frames: how many are predicted.
        step: seconds from frame to frame.
    """
    moments = [f"{1000 * step * frame:g}ms" for frame in range(1, frames + 1)]
    return tuple(f"{axis}_{moment}" for moment in moments for axis in AXES)


def future_frames(names: tuple[str, ...], by: str) -> int:
    """Return how many frames are to be predicted.

    Args:
        names: of the target's numbers, such as "x_16ms".
        by: plugin that predicts them, for the message.

    Raises:
        ConfigError: the target is not x, y and z at several times.
    """
    axes = [name.partition("_")[0] for name in names]
    if not axes or axes != list(AXES) * (len(axes) // len(AXES)):
        more = len(names) - MOST_NAMES
        told = ", ".join(names[:MOST_NAMES]) + (f" and {more} more" if more > 0 else "")
        raise ConfigError(
            f"{by} predicts x, y and z at one time after the other, but the target is {told}. Choose data of flights, "
            "whose numbers are called x_16ms, y_16ms, z_16ms and so on."
        )
    return len(axes) // len(AXES)
