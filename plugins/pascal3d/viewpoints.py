"""Which viewpoints occur: elevations and tilts distributed as in the PASCAL3D+ annotations."""

import numpy as np
from numpy.random import Generator

LEVELS = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
QUANTILES: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {
    "aeroplane": ((-82, -52, -14, -4, 2, 21, 52), (-29, -19, -4, 0, 3, 13, 26)),
    "bicycle": ((-22, -15, 2, 8, 16, 26, 42), (-21, -15, -5, -1, 4, 16, 23)),
    "boat": ((-18, -7, -1, 2, 7, 19, 49), (-14, -6, -2, 0, 3, 8, 12)),
    "bottle": ((-34, -17, -1, 6, 15, 31, 50), (-112, -31, -2, 0, 2, 10, 46)),
    "bus": ((-4, -3, -1, 0, 1, 5, 11), (-7, -4, -1, 0, 2, 3, 4)),
    "car": ((-8, -4, 1, 3, 6, 15, 23), (-10, -5, -2, 0, 3, 7, 14)),
    "chair": ((-6, -1, 10, 16, 23, 39, 49), (-12, -9, -3, 0, 3, 10, 19)),
    "diningtable": ((3, 8, 9, 17, 20, 33, 34), (-3, -2, -1, 1, 2, 5, 5)),
    "motorbike": ((-43, -21, -1, 8, 18, 31, 40), (-27, -20, -7, -2, 4, 29, 50)),
    "sofa": ((-11, -3, 7, 12, 19, 27, 56), (-14, -13, -4, 1, 4, 13, 18)),
    "train": ((-9, -5, -2, 0, 1, 8, 21), (-11, -6, -2, 0, 2, 6, 12)),
    "tvmonitor": ((-25, -16, -2, 1, 7, 22, 26), (-88, -13, -2, 0, 2, 8, 15)),
}
"""Elevation and tilt of each class, degrees, at `LEVELS`: measured on the 2,108 objects of PASCAL3D+ (Xiang
et al., WACV 2014) that are in the VOC 2012 validation set and neither truncated, occluded nor difficult."""


def viewpoint(category: str, random: Generator) -> tuple[float, float, float]:
    """Azimuth (uniform), elevation and tilt (between the measured quantiles), degrees."""
    elevation, tilt = (
        float(np.interp(random.uniform(LEVELS[0], LEVELS[-1]), LEVELS, levels))
        for levels in QUANTILES[category]
    )
    return float(random.uniform(0, 360)), elevation, tilt
