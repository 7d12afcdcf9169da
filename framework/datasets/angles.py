"""Looks at a user's angles, whether they are in the unit that is said."""

import math

import numpy as np
from jaxtyping import Float

from framework.datasets.csv_columns import ENOUGH_ROWS


def unlike_degrees(values: Float[np.ndarray, "rows"]) -> str:
    """What makes angles look like radians, where degrees are said; "" where nothing does."""
    found = np.abs(values[np.isfinite(values)])
    largest = found.max(initial=0.0)
    if len(found) > ENOUGH_ROWS and 0 < largest <= 2 * math.pi:
        return f"none of {len(found)} values exceeds {largest:.4g}: this looks like radians; wanted degrees"
    return ""


def unlike_radians(values: Float[np.ndarray, "rows"]) -> str:
    """What makes angles look like degrees, where radians are said; "" where nothing does."""
    found = np.abs(values[np.isfinite(values)])
    beyond = found > 2 * math.pi
    if len(found) > ENOUGH_ROWS and 2 * beyond.sum() > len(found):
        return (
            f"{beyond.sum()} of {len(found)} values exceed 2π, the largest {found.max():.4g}: this looks like degrees; "
            "wanted radians"
        )
    return ""
