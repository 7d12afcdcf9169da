"""Checks that find angles in another unit than the one that the user states."""

import math

import numpy as np
from jaxtyping import Float

from framework.datasets.csv_columns import ENOUGH_ROWS


def unlike_degrees(values: Float[np.ndarray, "rows"]) -> str:
    """Return the reason why values that are stated to be degrees look like radians; "" if they do not."""
    magnitudes = np.abs(values[np.isfinite(values)])
    largest = magnitudes.max(initial=0.0)
    if len(magnitudes) > ENOUGH_ROWS and 0 < largest <= 2 * math.pi:
        return (
            f"none of {len(magnitudes)} values exceeds {largest:.4g}: this looks like radians, but degrees are "
            "expected"
        )
    return ""


def unlike_radians(values: Float[np.ndarray, "rows"]) -> str:
    """Return the reason why values that are stated to be radians look like degrees; "" if they do not."""
    magnitudes = np.abs(values[np.isfinite(values)])
    beyond = magnitudes > 2 * math.pi
    if len(magnitudes) > ENOUGH_ROWS and 2 * beyond.sum() > len(magnitudes):
        return (
            f"{beyond.sum()} of {len(magnitudes)} values exceed 2π, the largest {magnitudes.max():.4g}: this looks "
            "like degrees, but radians are expected"
        )
    return ""
