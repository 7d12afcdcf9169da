"""Image that shows a row of numbers as bars."""

import numpy as np
from jaxtyping import Float, UInt8

HEIGHT = 64
WIDTH = 256
"""Width of the image, pixels; with more columns than half as many, each column has two pixels."""
REACH = 3.0
"""Standard deviations from the middle to the border; longer bars are cut off."""
UP, DOWN, MIDDLE = (31, 119, 180), (214, 39, 40), (150, 150, 150)


def bars(values: Float[np.ndarray, "column"]) -> UInt8[np.ndarray, "height width 3"]:
    """Return an image with one bar per column, blue above the mean of the training rows and red below it, on white."""
    pitch = max(2, WIDTH // len(values))
    canvas = np.full((HEIGHT, pitch * len(values), 3), 255, np.uint8)
    middle = HEIGHT // 2
    length = np.rint(np.abs(values).clip(0, REACH) / REACH * middle).astype(int)
    gap = max(1, pitch // 8)
    for column, (value, pixels) in enumerate(zip(values, length, strict=True)):
        place = slice(column * pitch, (column + 1) * pitch - gap)
        if value > 0:
            canvas[middle - pixels : middle, place] = UP
        else:
            canvas[middle : middle + pixels, place] = DOWN
    canvas[middle - 1 : middle + 1] = MIDDLE
    return canvas
