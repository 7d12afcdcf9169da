"""Image of a Z-spectrum: a curve over its offsets, with Z from 0 to 1."""

import numpy as np
from jaxtyping import Float, UInt8

HEIGHT, PITCH = 64, 3
"""Height of the image, and width of each offset, pixels."""
LINE, BELOW = (31, 119, 180), (222, 235, 247)


def curve(values: Float[np.ndarray, "offset"]) -> UInt8[np.ndarray, "height width 3"]:
    """Return an image of the curve of Z (`values`) over the offsets, blue on white, with the area below it filled."""
    canvas = np.full((HEIGHT, PITCH * len(values), 3), 255, np.uint8)
    top = np.rint((1 - np.nan_to_num(values).clip(0, 1.05) / 1.05) * (HEIGHT - 2)).astype(int)
    for offset, row in enumerate(top):
        columns = slice(offset * PITCH, (offset + 1) * PITCH)
        canvas[row:, columns] = BELOW
        canvas[row : row + 2, columns] = LINE
    return canvas
