"""Resampling of Z-spectra that were measured at other offsets than the model reads."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from framework.errors import DataError

SAME = 1e-3
"""Greatest difference, ppm, of offsets that count as the same."""


def resampled(
    spectra: Float[np.ndarray, "voxel given"],
    given: Float[np.ndarray, "given"],
    wanted: Sequence[float],
    where: str,
) -> Float[np.ndarray, "voxel wanted"]:
    """Return spectra at the model's offsets.

    Spectra are unchanged where the offsets are the same; otherwise they are interpolated by piecewise cubics that do
    not overshoot (Fritsch & Carlson 1980).

    Args:
        spectra: the measured spectra.
        given: their offsets, ascending, ppm.
        wanted: the model's offsets, ascending, ppm.
        where: name of the file, for the message.

    Raises:
        DataError: the given offsets do not reach as far as the wanted ones, or are too few to resolve the lines.
    """
    if len(given) == len(wanted) and np.abs(given - wanted).max() <= SAME:
        return spectra
    if given[0] > wanted[0] + SAME or given[-1] < wanted[-1] - SAME:
        raise DataError(
            f"{where}: its {len(given)} offsets reach from {given[0]:g} to {given[-1]:g} ppm, but the model reads "
            f"{wanted[0]:g} to {wanted[-1]:g} ppm. Train on offsets that both have (data.offsets), or measure further."
        )
    inside = [offset for offset in wanted if abs(offset) <= 6]
    gaps = (
        np.diff(given)[np.searchsorted(given, inside).clip(1, len(given) - 1) - 1] if inside else np.zeros(1)
    )
    if gaps.max() > 1.5:
        raise DataError(
            f"{where}: within 6 ppm of water its offsets are up to {gaps.max():g} ppm apart, which follows no line; "
            "wanted at most 1.5 ppm."
        )
    ends = np.clip(wanted, given[0], given[-1])
    found = np.full((len(spectra), len(wanted)), np.nan)
    whole = np.isfinite(spectra).all(1)
    if whole.any():
        found[whole] = PchipInterpolator(given, spectra[whole], axis=1)(ends)
    return found
