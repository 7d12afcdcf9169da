"""Image of the ball's positions in the frames that a model reads, in a side view."""

import numpy as np
from jaxtyping import Float, UInt8

HEIGHT, WIDTH = 96, 256
"""Height and width of the image, pixels."""
DOT = 2
"""Half the side of the square that shows a frame, pixels."""
MARGIN = 8


def side_view(frames: Float[np.ndarray, "frame 5"]) -> UInt8[np.ndarray, "height width 3"]:
    """Return an image of the ball at each frame, seen from the side: y to the right and z up, both in one scale.

    Early frames are pale, and the last frame is red.
    """
    canvas = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    present = frames[frames[:, 4] > 0.5]
    if not len(present):
        return canvas
    positions = present[:, 2:4].astype(float).clip(-1e6, 1e6)
    low, high = positions.min(0), positions.max(0)
    scale = min(
        (WIDTH - 2 * MARGIN) / max(high[0] - low[0], 1e-3),
        (HEIGHT - 2 * MARGIN) / max(high[1] - low[1], 1e-3),
    )
    middle = (low + high) / 2
    for number, (y, z) in enumerate(positions, start=1):
        column = round(WIDTH / 2 + scale * (y - middle[0]))
        row = round(HEIGHT / 2 - scale * (z - middle[1]))
        share = 1 - 0.8 * number / len(positions)
        color = (
            (214, 39, 40)
            if number == len(positions)
            else tuple(int(255 * share + c * (1 - share)) for c in (31, 119, 180))
        )
        canvas[max(0, row - DOT) : row + DOT + 1, max(0, column - DOT) : column + DOT + 1] = color
    return canvas
