"""Generator of coefficients.npz, run with `python -m plugins.density_head.von_mises.fit_coefficients`; needs mpmath.

The approximated functions (`smooth`) are smooth in v = 2/(κ+2) ∈ [0, 1], for κ ∈ [0, ∞]. The interval of v is divided
into equal pieces, whose number is a power of two, so that v's piece and its position y ∈ [-1, 1] there are found
without rounding. On each piece the function is interpolated at Chebyshev nodes in 60 digits and written as a polynomial
in y. The errors of the polynomial and of its first derivative in v, from which 1 - A(κ) is computed, stay within a
tolerance.
"""

from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import mpmath
import numpy as np

mpmath.mp.dps = 60
Real = Any  # an mpmath number: the package declares no types
NAMES = ("log_peak", "ratio", "ratio_slope")
PIECES = {"float32": 32, "float64": 64}
BORDERS = ("0", "0.125", "0.3125", "0.625", "1")
CHAIN_TOLERANCE = mpmath.mpf("4e-8")
"""Tolerance on the few pieces between BORDERS, which compiled code in float32 uses.

The pieces are shorter near v = 0, since the singularities of log I0 accumulate there.
"""
TOLERANCE = {"float32": mpmath.mpf("1e-8"), "float64": mpmath.mpf("2e-17")}
NODES = 24
QUADRATURES = (14, 40)


def bessel(kappa: Real) -> tuple[Real, Real]:
    """Return log(I0(κ) exp(-κ)) and 1 - I1(κ)/I0(κ).

    They are computed by the asymptotic series (DLMF 10.40.1) if κ is so large that the series has 60 digits.
    """
    if kappa < 400:
        zero, first = mpmath.besseli(0, kappa), mpmath.besseli(1, kappa)
        return mpmath.log(zero) - kappa, 1 - first / zero
    zero, first = (_hankel_series(order, kappa) for order in (0, 1))
    return mpmath.log(zero) - mpmath.log(2 * mpmath.pi * kappa) / 2, (zero - first) / zero


def _hankel_series(order: int, kappa: Real) -> Real:
    """Return √(2πκ) exp(-κ) I_order(κ) for the modified Bessel function I_order, by its asymptotic series."""
    total = term = mpmath.mpf(1)
    for j in range(1, 400):
        term *= -mpmath.mpf(4 * order**2 - (2 * j - 1) ** 2) / (8 * j * kappa)
        total += term
        if abs(term) < mpmath.mpf(10) ** -70:
            break
    return total


@cache
def smooth(v: Real) -> tuple[Real, ...]:
    """Return the values of the functions that the polynomials approximate, in the order of NAMES.

    The argument v = 2/(κ+2) stands for the concentration κ = 2/v - 2, so that v in [0, 1] covers all κ from infinity to
    0. With A = I1(κ)/I0(κ) and its derivative A' = 1 - A² - A/κ, the functions are

    - "log_peak": log(2π I0(κ) exp(-κ)) + log(κ+2)/2,
    - "ratio": A (κ+2)/κ,
    - "ratio_slope": A' (κ+2)²/2.
    """
    if v == 0:
        return mpmath.log(2 * mpmath.pi) / 2, mpmath.mpf(1), mpmath.mpf(1) / 4
    kappa = 2 / v - 2
    if kappa == 0:
        return mpmath.log(2 * mpmath.pi) + mpmath.log(2) / 2, mpmath.mpf(1), mpmath.mpf(1)
    log_scaled, complement = bessel(kappa)
    ratio = 1 - complement
    slope = 1 - ratio**2 - ratio / kappa
    return (
        mpmath.log(2 * mpmath.pi) + log_scaled + mpmath.log(kappa + 2) / 2,
        ratio * (kappa + 2) / kappa,
        slope * (kappa + 2) ** 2 / 2,
    )


def chebyshev_series(low: Real, high: Real, which: int) -> list[Real]:
    """Return the coefficients of a Chebyshev series that interpolates a function of `smooth` on the interval of v.

    Args:
        low: lower end of the interval.
        high: upper end of the interval.
        which: index of the function in NAMES.
    """
    angles = [mpmath.pi * (2 * i + 1) / (2 * NODES) for i in range(NODES)]
    values = [smooth((low + high) / 2 + (high - low) / 2 * mpmath.cos(angle))[which] for angle in angles]
    return [
        mpmath.mpf(2 if j else 1)
        / NODES
        * mpmath.fsum(value * mpmath.cos(j * angle) for value, angle in zip(values, angles, strict=True))
        for j in range(NODES)
    ]


def degree(series: list[Real], pieces: Real, tolerance: Real) -> int:
    """Return the smallest degree at which a Chebyshev series on a piece of the length 1 / `pieces` may be cut.

    The terms that are cut must add up to less than the tolerance, and their derivatives with respect to v to less than
    four times the tolerance. The second bound is needed for the function G(v) = "log_peak" of `smooth`: from its
    derivative the mean resultant length A(κ) is computed, by 1 - A(κ) = v/4 + v² G'(v)/2.
    """
    return next(
        d
        for d in range(NODES)
        if sum(abs(c) for c in series[d + 1 :]) < tolerance
        and sum(2 * pieces * j * j * abs(series[j]) for j in range(d + 1, NODES)) < 4 * tolerance
    )


def powers(series: list[Real]) -> list[Real]:
    """Return the coefficients of 1, y, y², … of the polynomial that a Chebyshev series in y describes."""
    coefficients = [mpmath.mpf(0)] * len(series)
    before, current = [mpmath.mpf(1)], [mpmath.mpf(0), mpmath.mpf(1)]
    for j, weight in enumerate(series):
        if j >= 2:
            following = [mpmath.mpf(0)] + [2 * c for c in current]
            for i, c in enumerate(before):
                following[i] -= c
            before, current = current, following
        for i, c in enumerate(before if j == 0 else current):
            coefficients[i] += weight * c
    return coefficients


def table(dtype: str, which: int) -> list[tuple[float, ...]]:
    """Return the polynomials that approximate a function of `smooth` on equal pieces of 0 ≤ v ≤ 1, v = 2/(κ+2).

    All pieces have the largest degree that any of them needs.

    Args:
        dtype: number type of the coefficients, which decides how many pieces there are (PIECES).
        which: index of the function in NAMES.

    Returns:
        The coefficients, (power, piece), the pieces in ascending order of v.
    """
    count = PIECES[dtype]
    edges = [mpmath.mpf(i) / count for i in range(count + 1)]
    series = [chebyshev_series(low, high, which) for low, high in pairwise(edges)]
    highest = max(degree(piece, count, TOLERANCE[dtype]) for piece in series)
    columns = [powers(piece[: highest + 1]) for piece in series]
    return [tuple(float(column[j]) for column in columns) for j in range(highest + 1)]


def chain(which: int) -> list[tuple[float, ...]]:
    """Return the coefficients of function number `which` on the pieces of v between BORDERS, (power, piece).

    All pieces have the largest degree that any of them needs.
    """
    spans = list(pairwise(mpmath.mpf(border) for border in BORDERS))
    series = [chebyshev_series(low, high, which) for low, high in spans]
    highest = max(
        degree(piece, 1 / (high - low), CHAIN_TOLERANCE)
        for piece, (low, high) in zip(series, spans, strict=True)
    )
    columns = [powers(piece[: highest + 1]) for piece in series]
    return [tuple(float(column[j]) for column in columns) for j in range(highest + 1)]


def gauss_legendre(count: int) -> list[tuple[float, float]]:
    """Return the pairs (position, weight) of Gauss-Legendre quadrature on [0, 1], by Newton's method in 60 digits.

    In float64 arithmetic the outer weights would lose two digits.
    """
    nodes = []
    for i in range(count):
        x = mpmath.cos(mpmath.pi * (i + mpmath.mpf("0.75")) / (count + mpmath.mpf("0.5")))
        slope = mpmath.mpf(1)
        for _ in range(8):
            before, current = mpmath.mpf(1), x  # Legendre polynomials (DLMF 18.9.1)
            for n in range(1, count):
                before, current = current, ((2 * n + 1) * x * current - n * before) / (n + 1)
            slope = count * (x * current - before) / (x * x - 1)
            x -= current / slope
        nodes.append((float((1 - x) / 2), float(1 / ((1 - x * x) * slope**2))))
    return nodes


def main() -> None:
    """Write coefficients.npz; its keys are explained in coefficients.py."""
    arrays: dict[str, Any] = {"borders": np.array([float(border) for border in BORDERS])}
    for which, name in enumerate(NAMES):
        for dtype in PIECES:
            arrays[f"table/{dtype}/{name}"] = np.array(table(dtype, which))
        arrays[f"chain/{name}"] = np.array(chain(which))
    for count in QUADRATURES:
        arrays[f"nodes/{count}"] = np.array(gauss_legendre(count))
    np.savez_compressed(Path(__file__).with_name("coefficients.npz"), **arrays)


if __name__ == "__main__":
    main()
