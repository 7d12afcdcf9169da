"""Checks whether a user's angles look like another unit than the stated one."""

import math

import numpy as np
from jaxtyping import Float

from framework.datasets.csv_columns import ENOUGH_ROWS


def unlike_degrees(values: Float[np.ndarray, "rows"]) -> str:
    """Return the reason why values stated in degrees look like radians, or "" if they do not."""
    found = np.abs(values[np.isfinite(values)])
    largest = found.max(initial=0.0)
    if len(found) > ENOUGH_ROWS and 0 < largest <= 2 * math.pi:
        return f"none of {len(found)} values exceeds {largest:.4g}: this looks like radians; wanted degrees"
    return ""


def unlike_radians(values: Float[np.ndarray, "rows"]) -> str:
    """Return the reason why values stated in radians look like degrees, or "" if they do not."""
    found = np.abs(values[np.isfinite(values)])
    beyond = found > 2 * math.pi
    if len(found) > ENOUGH_ROWS and 2 * beyond.sum() > len(found):
        return (
            f"{beyond.sum()} of {len(found)} values exceed 2π, the largest {found.max():.4g}: this looks like degrees; "
            "wanted radians"
        )
    return ""
