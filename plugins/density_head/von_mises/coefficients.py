"""Polynomials of the Bessel functions and quadrature nodes, read from coefficients.npz (see fit_coefficients.py)."""

from pathlib import Path

import numpy as np

SOURCE = Path(__file__).with_name("coefficients.npz")

with np.load(SOURCE, allow_pickle=False) as _file:
    _ARRAYS: dict[str, np.ndarray] = {key: _file[key] for key in _file.files}


def _read(prefix: str) -> dict[str, np.ndarray]:
    """Return the arrays whose keys begin with `prefix`, by the rest of their keys."""
    return {key.removeprefix(prefix): array for key, array in _ARRAYS.items() if key.startswith(prefix)}


TABLES: dict[str, dict[str, np.ndarray]] = {
    "float32": _read("table/float32/"),
    "float64": _read("table/float64/"),
}
"""Coefficients of the polynomials, (power, piece) in float64, by the dtype of the results and the function's name.

v = 2/(κ+2) is in [0, 1], which is divided into equal pieces; y ∈ [-1, 1] is the position of v in its piece. Row j holds
the coefficient of y^j on each piece, in ascending order of v.
"""

BORDERS: tuple[float, ...] = tuple(_ARRAYS["borders"].tolist())
"""Borders of the few pieces of unequal length, in v, that compiled code in float32 uses."""

CHAINS: dict[str, tuple[tuple[float, ...], ...]] = {
    name: tuple(map(tuple, array.tolist())) for name, array in _read("chain/").items()
}
"""Coefficients of the polynomials on the pieces between BORDERS, by the name of the function.

Row j holds the coefficients of y^j, one for each piece.

They are Python numbers, because a compiler writes them into its code.
"""

NODES: dict[int, tuple[tuple[float, float], ...]] = {
    int(count): tuple((position, weight) for position, weight in array.tolist())
    for count, array in _read("nodes/").items()
}
"""Pairs (position, weight) of Gauss-Legendre quadrature on [0, 1], by the number of nodes."""
