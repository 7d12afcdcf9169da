"""Image of a row of numbers as bars."""

import numpy as np
from jaxtyping import Float, UInt8

HEIGHT = 64
WIDTH = 256
"""Width of the image, pixels. With more than WIDTH / 2 columns, the image is wider and each column has two pixels."""
LARGEST = 3.0
"""Number of standard deviations from the middle of the image to its border; longer bars are cut off."""
UP, DOWN, MIDDLE = (31, 119, 180), (214, 39, 40), (150, 150, 150)


def bars(values: Float[np.ndarray, "column"]) -> UInt8[np.ndarray, "height width 3"]:
    """Return an image with one bar per column, blue if the value is above the training mean and red if it is below."""
    pitch = max(2, WIDTH // len(values))
    canvas = np.full((HEIGHT, pitch * len(values), 3), 255, np.uint8)
    middle = HEIGHT // 2
    length = np.rint(np.abs(values).clip(0, LARGEST) / LARGEST * middle).astype(int)
    gap = max(1, pitch // 8)
    for column, (value, pixels) in enumerate(zip(values, length, strict=True)):
        bar = slice(column * pitch, (column + 1) * pitch - gap)
        if value > 0:
            canvas[middle - pixels : middle, bar] = UP
        else:
            canvas[middle : middle + pixels, bar] = DOWN
    canvas[middle - 1 : middle + 1] = MIDDLE
    return canvas
