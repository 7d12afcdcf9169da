"""Resampling of Z-spectra that were measured at other offsets than the model reads."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from framework.errors import DataError

SAME = 1e-3
"""Largest difference, ppm, of two offsets that count as equal."""


def resample(
    spectra: Float[np.ndarray, "voxel measured"],
    measured: Float[np.ndarray, "measured"],
    required: Sequence[float],
    file: str,
) -> Float[np.ndarray, "voxel required"]:
    """Return the spectra at the model's offsets.

    Spectra that were measured at the model's offsets stay unchanged. Other spectra are interpolated by piecewise cubics
    that do not overshoot (Fritsch & Carlson 1980).

    Args:
        spectra: The measured spectra.
        measured: Offsets of the measured spectra, ascending, ppm.
        required: Offsets of the model, ascending, ppm.
        file: Name of the file, for the error message.

    Raises:
        DataError: The measured offsets do not cover the model's, or are too few to resolve the lines.
    """
    if len(measured) == len(required) and np.abs(measured - required).max() <= SAME:
        return spectra
    if measured[0] > required[0] + SAME or measured[-1] < required[-1] - SAME:
        raise DataError(
            f"{file}: {len(measured)} offsets were measured, from {measured[0]:g} to {measured[-1]:g} ppm, but the "
            f"model reads {required[0]:g} to {required[-1]:g} ppm. Train with offsets that were measured "
            "(data.offsets), or measure a wider range."
        )
    near_water = [offset for offset in required if abs(offset) <= 6]
    gaps = (
        np.diff(measured)[np.searchsorted(measured, near_water).clip(1, len(measured) - 1) - 1]
        if near_water
        else np.zeros(1)
    )
    if gaps.max() > 1.5:
        raise DataError(
            f"{file}: Within 6 ppm of water, neighbouring offsets are up to {gaps.max():g} ppm apart, which is too far "
            "to resolve a line. Measure at offsets at most 1.5 ppm apart."
        )
    clipped = np.clip(required, measured[0], measured[-1])
    interpolated = np.full((len(spectra), len(required)), np.nan)
    finite = np.isfinite(spectra).all(1)
    if finite.any():
        interpolated[finite] = PchipInterpolator(measured, spectra[finite], axis=1)(clipped)
    return interpolated
