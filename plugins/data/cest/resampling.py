"""Z-spectra that were measured at other offsets than the model reads."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from framework.errors import DataError

SAME = 1e-3
"""Offsets that differ by no more, ppm, are the same."""


def resampled(
    spectra: Float[np.ndarray, "voxel given"],
    given: Float[np.ndarray, "given"],
    wanted: Sequence[float],
    where: str,
) -> Float[np.ndarray, "voxel wanted"]:
    """Spectra as the model reads them: as they are where the offsets are the same, else by cubic pieces that overshoot
    nowhere (Fritsch & Carlson 1980).

    Args:
        given: ascending.
        where: the file, for the message.

    Raises:
        DataError: the given offsets do not reach as far as the wanted ones, or are too few to follow the lines.
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
