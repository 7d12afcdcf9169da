"""The offsets at which a model reads Z-spectra, and spectra that were measured at others."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from framework.errors import DataError

# fmt: off
OFFSETS = (
    -39.9982, -29.9986, -19.9991, -11.9985, -8.9988, -7.2476, -6.4996, -6.2494, -5.9992, -5.4989, -4.9985, -4.4982,
    -4.248, -3.9978, -3.7476, -3.5, -3.2498, -2.9996, -2.7494, -2.4993, -2.2491, -2.099, -1.9989, -1.8988, -1.7988,
    -1.6987, -1.5986, -1.4986, -1.3985, -1.2984, -1.1983, -1.0983, -0.9982, -0.8981, -0.748, -0.4979, -0.1976, 0.0,
    0.1976, 0.4979, 0.5979, 0.698, 0.7981, 0.9982, 1.0983, 1.1983, 1.2984, 1.3985, 1.4986, 1.5986, 1.6987, 1.7988,
    1.8988, 1.9989, 2.099, 2.199, 2.2991, 2.3992, 2.4993, 2.5993, 2.6994, 2.7995, 2.8995, 2.9996, 3.0997, 3.1997,
    3.2998, 3.3999, 3.5, 3.5975, 3.6976, 3.7977, 3.8977, 3.9978, 4.0979, 4.198, 4.298, 4.3981, 4.4982, 4.5982, 4.6983,
    4.7984, 4.8984, 4.9985, 5.0986, 5.1987, 5.2987, 6.2494, 7.9981, 11.9985, 19.9991, 29.9986, 39.9982,
)
# fmt: on
"""ppm; of the human brain at 7 T that is published with CESTEval (V. Khlebnikov, MIT)."""
SAME = 1e-3
"""Offsets that differ by no more, ppm, are the same."""


def offsets_of(wanted: Sequence[float] | None) -> tuple[float, ...]:
    """A list from a config; None: OFFSETS.

    Raises:
        DataError: they do not ascend.
    """
    found = OFFSETS if wanted is None else tuple(map(float, wanted))
    if len(found) < 2 or not np.all(np.diff(found) > 0):
        raise DataError(f"offsets {list(found)}: wanted two or more, ascending, in ppm.")
    return found


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
