"""The Bessel functions I0 and I1 in the forms of the von Mises density, by the polynomials in coefficients.npz."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from plugins.density_head.von_mises.coefficients import BORDERS, CHAINS, TABLES

_TABLES = {
    (getattr(torch, dtype), name): torch.from_numpy(rows).to(getattr(torch, dtype))
    for dtype, functions in TABLES.items()
    for name, rows in functions.items()
}


def log_height(concentration: Tensor) -> Tensor:
    """Return the log-density at the mean, κ - log(2π I0(κ)), nats; see `functions.log_peak` for its gradient."""
    return torch.log(concentration + 2) / 2 - polynomial("log_peak", 2 / (concentration + 2))


def height_and_deviation(concentration: Tensor) -> tuple[Tensor, Tensor]:
    """Return log_peak and its derivative 1 - A = v (1/4 + v G'(v)/2), G the polynomial, in one pass."""
    v = 2 / (concentration + 2)
    rows, piece, y, by_v = _locate("log_peak", v)
    total = _coefficient(rows[-1], piece, y)
    slope = torch.zeros_like(total)
    for row in range(len(rows) - 2, -1, -1):
        slope = torch.addcmul(total, slope, y)
        total = _multiply_add(_coefficient(rows[row], piece, y), total, y)
    return torch.log(concentration + 2) / 2 - total, v * (0.25 + v * (slope * (by_v / 2)))


def deviation_of(concentration: Tensor) -> Tensor:
    """Return 1 - A(κ)."""
    return height_and_deviation(concentration)[1]


def polynomial(name: str, v: Tensor) -> Tensor:
    """Return the smooth function `name` of v = 2/(κ+2), as defined by `smooth` in fit_coefficients.py."""
    rows, piece, y, _ = _locate(name, v)
    total = _coefficient(rows[-1], piece, y)
    for row in range(len(rows) - 2, -1, -1):
        total = _multiply_add(_coefficient(rows[row], piece, y), total, y)
    return total


def _locate(name: str, v: Tensor) -> tuple[Any, Any, Tensor, Any]:
    """Return the rows of coefficients, the piece of [0, 1] that holds v, the position y ∈ [-1, 1] in it, and dy/dv.

    Compiled code in float32 has few pieces and selects their coefficients by comparisons; otherwise a table is read.
    """
    if v.dtype == torch.float32 and torch.compiler.is_compiling():
        rows = CHAINS[name]
        beyond = tuple(v >= border for border in BORDERS[1:-1])
        spans = list(pairwise(BORDERS))
        middle = _select_piece([(low + high) / 2 for low, high in spans], beyond, v)
        slope = _select_piece([2 / (high - low) for low, high in spans], beyond, v)
        return rows, beyond, (v - middle) * slope, slope
    rows = _TABLES[v.dtype, name].to(v.device)
    pieces = rows.shape[1]
    place = v * pieces
    # NaN has no piece: it gets any piece, and stays NaN in y
    piece = place.detach().to(torch.int32).clamp_(0, pieces - 1)
    return rows, piece, 2 * (place - piece) - 1, 2 * pieces


def _select_piece(values: Sequence[float], beyond: tuple[Tensor, ...], like: Tensor) -> Tensor:
    """Return for each element the value of its piece: `beyond` says for each inner border whether it is passed."""
    selected = torch.full_like(like, values[0])
    for passed, value in zip(beyond, values[1:], strict=True):
        selected = torch.where(passed, value, selected)
    return selected


def _coefficient(row: Any, piece: Any, like: Tensor) -> Tensor:
    if isinstance(piece, tuple):
        return _select_piece(row, piece, like)
    if torch.compiler.is_compiling():
        return row[piece]
    # the same result in a quarter of the time without a compiler
    return row.index_select(0, piece.reshape(-1)).view(piece.shape)


def _multiply_add(coefficient: Tensor, total: Tensor, y: Tensor) -> Tensor:
    """Return coefficient + total y; the result replaces the coefficient in memory if no gradient needs it."""
    if torch.compiler.is_compiling() or (torch.is_grad_enabled() and total.requires_grad | y.requires_grad):
        return torch.addcmul(coefficient, total, y)
    return coefficient.addcmul_(total, y)
