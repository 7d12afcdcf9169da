"""Layout of the numbers of a flight: those that models read, frame by frame, and those that they predict."""

from framework.errors import ConfigError

PARTS = ("time", "x", "y", "z", "seen")
"""Names of the numbers that a model reads for each frame.

"time" is in seconds relative to the last frame that is read, and not above 0. "x", "y" and "z" are in metres. "seen" is
1 if the ball was observed in the frame, and 0 if the frame is missing. The other numbers of a missing frame are 0.
"""
GRAVITY = 9.81
"""Acceleration of gravity, m/s², with which positions are interpolated between frames or extrapolated after them."""
AXES = "xyz"
"""Names of the coordinates."""
MOST_NAMES = 10
"""Number of names that the message about a wrong target lists."""


def future_names(frames: int, step: float) -> tuple[str, ...]:
    """Return the names of the numbers that are predicted, frame by frame: "x_16ms" is x after 16 ms, in metres.

    Args:
        frames: number of predicted frames.
        step: seconds between frames.
    """
    moments = [f"{1000 * step * frame:g}ms" for frame in range(1, frames + 1)]
    return tuple(f"{axis}_{moment}" for moment in moments for axis in AXES)


def future_frames(names: tuple[str, ...], by: str) -> int:
    """Return the number of predicted frames.

    Args:
        names: names of the target's numbers, such as "x_16ms".
        by: plugin that predicts them, for the message.

    Raises:
        ConfigError: the target is not x, y and z at several times.
    """
    axes = [name.partition("_")[0] for name in names]
    if not axes or axes != list(AXES) * (len(axes) // len(AXES)):
        more = len(names) - MOST_NAMES
        target_names = ", ".join(names[:MOST_NAMES]) + (f" and {more} more" if more > 0 else "")
        raise ConfigError(
            f"{by} predicts x, y and z at successive times, but the target is {target_names}. Choose data of flights, "
            "whose numbers are called x_16ms, y_16ms, z_16ms and so on."
        )
    return len(axes) // len(AXES)
