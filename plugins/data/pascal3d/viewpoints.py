"""Random viewpoints: elevations and tilts are distributed as in the PASCAL3D+ annotations."""

import numpy as np
from numpy.random import Generator

LEVELS = (0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.98, 0.99)
QUANTILES: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {
    "aeroplane": (
        (-82, -67, -52, -34, -14, -4, 2, 7, 21, 43, 52),
        (-29, -26, -19, -11, -4, 0, 3, 9, 13, 20, 26),
    ),
    "bicycle": (
        (-22, -20, -15, -5, 2, 8, 16, 22, 26, 36, 42),
        (-21, -19, -15, -10, -5, -1, 4, 10, 16, 21, 23),
    ),
    "boat": (
        (-18, -13, -7, -4, -1, 2, 7, 15, 19, 40, 49),
        (-14, -11, -6, -5, -2, 0, 3, 6, 8, 10, 12),
    ),
    "bottle": (
        (-34, -30, -17, -11, -1, 6, 15, 23, 31, 41, 50),
        (-112, -103, -31, -7, -2, 0, 2, 7, 10, 29, 46),
    ),
    "bus": (
        (-4, -4, -3, -2, -1, 0, 1, 3, 5, 7, 11),
        (-7, -7, -4, -3, -1, 0, 2, 3, 3, 4, 4),
    ),
    "car": (
        (-8, -6, -4, -2, 1, 3, 6, 12, 15, 22, 23),
        (-10, -8, -5, -4, -2, 0, 3, 5, 7, 11, 14),
    ),
    "chair": (
        (-6, -3, -1, 3, 10, 16, 23, 32, 39, 47, 49),
        (-12, -11, -9, -6, -3, 0, 3, 6, 10, 14, 19),
    ),
    "diningtable": (
        (3, 4, 8, 8, 9, 17, 20, 25, 33, 34, 34),
        (-3, -3, -2, -2, -1, 1, 2, 3, 5, 5, 5),
    ),
    "motorbike": (
        (-43, -32, -21, -9, -1, 8, 18, 23, 31, 38, 40),
        (-27, -25, -20, -14, -7, -2, 4, 14, 29, 42, 50),
    ),
    "sofa": (
        (-11, -7, -3, 3, 7, 12, 19, 26, 27, 41, 56),
        (-14, -13, -13, -8, -4, 1, 4, 10, 13, 16, 18),
    ),
    "train": (
        (-9, -8, -5, -4, -2, 0, 1, 5, 8, 13, 21),
        (-11, -9, -6, -4, -2, 0, 2, 5, 6, 11, 12),
    ),
    "tvmonitor": (
        (-25, -23, -16, -7, -2, 1, 7, 20, 22, 25, 26),
        (-88, -21, -13, -5, -2, 0, 2, 4, 8, 11, 15),
    ),
}
"""Quantiles of the elevation and of the tilt of each class, degrees, at the probabilities `LEVELS`.

The angles were measured on the 2,108 objects of PASCAL3D+ (Xiang et al., WACV 2014) that are in the VOC 2012 validation
set and neither truncated, occluded nor difficult.
"""


def viewpoint(category: str, random: Generator) -> tuple[float, float, float]:
    """Return a random azimuth (uniform), elevation and tilt (interpolated between the measured quantiles), degrees."""
    elevation, tilt = (
        float(np.interp(random.uniform(LEVELS[0], LEVELS[-1]), LEVELS, levels))
        for levels in QUANTILES[category]
    )
    return float(random.uniform(0, 360)), elevation, tilt
