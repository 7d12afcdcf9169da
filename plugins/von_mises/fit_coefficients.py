"""Writes coefficients.py: run by hand, `python -m plugins.von_mises.fit_coefficients`; needs mpmath.

Every function below is smooth on κ ∈ [0, ∞] as a function of v = 2/(κ+2) ∈ [0, 1]. On each piece of that
interval it is interpolated at Chebyshev nodes in 60 digits and written as a polynomial in y ∈ [-1, 1].
"""

from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import mpmath

mpmath.mp.dps = 60
Real = Any  # an mpmath number: the package declares no types
NAMES = ("log_peak", "one_minus_ratio", "ratio", "ratio_slope")
PIECES = {"float32": ("0", "0.12", "0.4", "1"), "float64": ("0", "0.06", "0.2", "0.45", "0.7", "1")}
TOLERANCE = {"float32": mpmath.mpf("1.5e-8"), "float64": mpmath.mpf("6e-18")}
NODES = 48


def bessel(kappa: Real) -> tuple[Real, Real]:
    """log(I0(κ) exp(-κ)) and 1 - I1(κ)/I0(κ); by asymptotic series (DLMF 10.40.1) where it has 60 digits."""
    if kappa < 400:
        zero, one = mpmath.besseli(0, kappa), mpmath.besseli(1, kappa)
        return mpmath.log(zero) - kappa, 1 - one / zero
    zero, one = (_hankel_series(order, kappa) for order in (0, 1))
    return mpmath.log(zero) - mpmath.log(2 * mpmath.pi * kappa) / 2, (zero - one) / zero


def _hankel_series(order: int, kappa: Real) -> Real:
    """√(2πκ) exp(-κ) I_order(κ)."""
    total = term = mpmath.mpf(1)
    for j in range(1, 400):
        term *= -mpmath.mpf(4 * order**2 - (2 * j - 1) ** 2) / (8 * j * kappa)
        total += term
        if abs(term) < mpmath.mpf(10) ** -70:
            break
    return total


@cache
def smooth(v: Real) -> tuple[Real, ...]:
    """The four functions at v, in the order of NAMES, with A = I1/I0:

    log(2π I0(κ) exp(-κ)) + log(κ+2)/2;  (1 - A)(1 + 2κ);  A (κ+2)/κ;  A' (κ+2)²/2 with A' = 1 - A² - A/κ.
    """
    if v == 0:
        return mpmath.log(2 * mpmath.pi) / 2, mpmath.mpf(1), mpmath.mpf(1), mpmath.mpf(1) / 4
    kappa = 2 / v - 2
    if kappa == 0:
        return mpmath.log(2 * mpmath.pi) + mpmath.log(2) / 2, mpmath.mpf(1), mpmath.mpf(1), mpmath.mpf(1)
    log_scaled, complement = bessel(kappa)
    ratio = 1 - complement
    slope = 1 - ratio**2 - ratio / kappa
    return (
        mpmath.log(2 * mpmath.pi) + log_scaled + mpmath.log(kappa + 2) / 2,
        complement * (1 + 2 * kappa),
        ratio * (kappa + 2) / kappa,
        slope * (kappa + 2) ** 2 / 2,
    )


def interpolate(low: Real, high: Real, which: int, tolerance: Real) -> list[Real]:
    """Coefficients, lowest power of y first, of the shortest Chebyshev series that meets the tolerance."""
    nodes = [mpmath.cos(mpmath.pi * (2 * i + 1) / (2 * NODES)) for i in range(NODES)]
    values = [smooth((low + high) / 2 + (high - low) / 2 * node)[which] for node in nodes]
    chebyshev = [
        mpmath.mpf(2 if j else 1)
        / NODES
        * sum(values[i] * mpmath.cos(j * mpmath.pi * (2 * i + 1) / (2 * NODES)) for i in range(NODES))
        for j in range(NODES)
    ]
    degree = next(d for d in range(NODES) if sum(abs(c) for c in chebyshev[d + 1 :]) < tolerance)
    powers = [mpmath.mpf(0)] * (degree + 1)
    before, current = [mpmath.mpf(1)], [mpmath.mpf(0), mpmath.mpf(1)]
    for j in range(degree + 1):
        if j >= 2:
            following = [mpmath.mpf(0)] + [2 * c for c in current]
            for i, c in enumerate(before):
                following[i] -= c
            before, current = current, following
        for i, c in enumerate(before if j == 0 else current):
            powers[i] += chebyshev[j] * c
    return powers


def main() -> None:
    lines = [
        '"""Written by fit_coefficients.py; do not edit.',
        "",
        "Per dtype and function: (middle of v, half its width, coefficients of y, lowest power first).",
        '"""',
        "",
        "# fmt: off",
        "Piece = tuple[float, float, tuple[float, ...]]",
        "PIECES: dict[str, dict[str, tuple[Piece, ...]]] = {",
    ]
    for dtype, edges in PIECES.items():
        bounds = [mpmath.mpf(edge) for edge in edges]
        lines.append(f"    {dtype!r}: {{")
        for which, name in enumerate(NAMES):
            lines.append(f"        {name!r}: (")
            for low, high in pairwise(bounds):
                numbers = interpolate(low, high, which, TOLERANCE[dtype])
                lines.append(f"            ({float((low + high) / 2)!r}, {float((high - low) / 2)!r}, (")
                lines += [f"                {float(number)!r}," for number in numbers]
                lines.append("            )),")
            lines.append("        ),")
        lines.append("    },")
    lines.append("}")
    Path(__file__).with_name("coefficients.py").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
