"""Functions of the concentration κ of a von Mises density, computed by the polynomials in coefficients.npz.

The functions contain the modified Bessel functions I0 and I1 and their quotient A(κ) = I1(κ)/I0(κ).
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from plugins.density_head.von_mises.coefficients import BORDERS, CHAINS, TABLES
from plugins.density_head.von_mises.processor import is_transformed

_TABLES = {
    (getattr(torch, dtype), name): torch.from_numpy(rows).to(getattr(torch, dtype))
    for dtype, functions in TABLES.items()
    for name, rows in functions.items()
}


def log_height(concentration: Tensor) -> Tensor:
    """Return the log-density at the mean, κ - log(2π I0(κ)), nats, for the concentration κ."""
    return torch.log(concentration + 2) / 2 - polynomial("log_peak", 2 / (concentration + 2))


def height_and_deviation(concentration: Tensor) -> tuple[Tensor, Tensor]:
    """Return the log-density at the mean, as `log_height`, and its derivative in κ, 1 - A(κ), in one pass.

    With v = 2/(κ+2) and the polynomial G(v) that approximates log(2π I0(κ) exp(-κ)) + log(κ+2)/2 ("log_peak"), the
    derivative is v (1/4 + v G'(v)/2).
    """
    v = 2 / (concentration + 2)
    rows, piece, y, by_v = _locate("log_peak", v)
    total = _coefficient(rows[-1], piece, y)
    slope = torch.zeros_like(total)
    for row in range(len(rows) - 2, -1, -1):
        slope = torch.addcmul(total, slope, y)
        total = _multiply_add(_coefficient(rows[row], piece, y), total, y)
    return torch.log(concentration + 2) / 2 - total, v * (0.25 + v * (slope * (by_v / 2)))


def deviation_of(concentration: Tensor) -> Tensor:
    """Return 1 - A(κ) = 1 - I1(κ)/I0(κ) for the concentration κ."""
    return height_and_deviation(concentration)[1]


def polynomial(name: str, v: Tensor) -> Tensor:
    """Return the function with this name at v = 2/(κ+2); `smooth` in fit_coefficients.py defines the functions."""
    rows, piece, y, _ = _locate(name, v)
    total = _coefficient(rows[-1], piece, y)
    for row in range(len(rows) - 2, -1, -1):
        total = _multiply_add(_coefficient(rows[row], piece, y), total, y)
    return total


def _locate(name: str, v: Tensor) -> tuple[Any, Any, Tensor, Any]:
    """Return what is needed to evaluate the polynomial `name` at v.

    The interval [0, 1] of v is divided into pieces, each with a polynomial of its own. Compiled code in float32 has few
    pieces, and selects coefficients by comparisons of v with the borders; otherwise they are read from a table.

    Returns:
        The coefficients, one row for each power; the piece in which each v lies (for compiled code, whether v is beyond
        each inner border); the position y ∈ [-1, 1] of v in its piece; and the derivative dy/dv.
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
    piece = place.detach().to(torch.int32).clamp(0, pieces - 1)
    return rows, piece, 2 * (place - piece) - 1, 2 * pieces


def _select_piece(values: Sequence[float], beyond: tuple[Tensor, ...], like: Tensor) -> Tensor:
    """Return for each element the entry of `values` that belongs to the piece in which the element lies.

    `beyond` has one tensor for each inner border: whether the element lies beyond this border.
    """
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
    """Return coefficient + total · y, one step of Horner's method.

    If no gradient is needed, the sum overwrites `coefficient`.
    """
    if is_transformed():  # transforms do not know the other operations
        return coefficient + total * y
    if torch.compiler.is_compiling() or (torch.is_grad_enabled() and total.requires_grad | y.requires_grad):
        return torch.addcmul(coefficient, total, y)
    return coefficient.addcmul_(total, y)
