"""The offsets at which a model reads Z-spectra."""

from collections.abc import Sequence

import numpy as np

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
"""Offsets, ppm, of the spectra of the human brain at 7 T that were published with CESTEval (V. Khlebnikov, MIT)."""


def offsets_of(configured: Sequence[float] | None) -> tuple[float, ...]:
    """Return the frequency offsets that a config sets, ppm; if it sets None, return OFFSETS.

    Raises:
        DataError: there are fewer than two offsets, or they do not ascend.
    """
    offsets = OFFSETS if configured is None else tuple(map(float, configured))
    if len(offsets) < 2 or not np.all(np.diff(offsets) > 0):
        raise DataError(
            f"Got the offsets {list(offsets)}; expected two or more offsets, in ppm and ascending order."
        )
    return offsets
