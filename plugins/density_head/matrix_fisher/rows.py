"""Contract-test cases: the matrix Fisher head, with log-densities computed with 60 digits and another quadrature."""

from collections.abc import Iterator
from typing import Any

import mpmath
import numpy as np
import torch
from scipy import special

from framework.density_head import DensityHead
from framework.heads.rotations import ANGLES
from framework.target import Target
from framework.testing.rows import Case, HeadRow
from plugins.density_head.matrix_fisher.head import LARGEST_PARAMETER

TARGET = Target("angle", ANGLES)
TURN = [[2.0, -1.0, 2.0], [2.0, 2.0, -1.0], [-1.0, 2.0, 2.0]]
"""A rotation matrix multiplied by 3, so that all singular values are exactly 3."""
GENERIC = [[0.5, -1.25, 0.75], [2.0, 0.125, -0.5], [0.25, 1.5, -1.0]]
VALUES = [[0.3, 0.2, -0.1], [2.5, -1.2, 3.0], [-1.0, 1.5, 0.7], [4.0, 2.0, -5.0], [1000.0, -0.5, -1e6]]
RAWS = {
    "F = 0": np.zeros((3, 3)),
    "|F| = 1e-30": 1e-30 * np.array(GENERIC),
    "generic": np.array(GENERIC),
    "generic, |F| = 1e4": 8 * np.array(GENERIC),
    "generic, |F| = 1e8": 64 * np.array(GENERIC),
    "generic, raw 1e4": 1e4 * np.array(GENERIC),
    "generic, raw 1e30": 1e30 * np.array(GENERIC),
    "equal singular values": np.array(TURN),
    "equal singular values, raw 600": 200 * np.array(TURN),
    "equal, s₃ = -s₂": -np.array(TURN) / 4,
    "flat, large: s₃ = -s₂": np.diag([64.0, 32.0, -32.0]),
    "rank one": np.diag([0.0, 6.0, 0.0]),
    "rank one, large": np.diag([0.0, 600.0, 0.0]),
    "wildly different": np.diag([500.0, 1.0, 2.0**-10]),
    "wildly different, s₃ < 0": np.diag([500.0, -1.0, 2.0**-10]),
}


def exact(raw: np.ndarray, value: np.ndarray) -> float:
    """Return log p(a, e, t) = tr(FᵀR) - log c(F) + log(|cos e| / 8π²), nats.

    a, e and t are the angles in `value`, R is their rotation, and F the parameter for `raw`. All terms are computed
    with 60 digits, except for the factor c(F) exp(-tr S) of `log_constant`, which has 15.
    """
    with mpmath.workdps(60):
        parameter = _parameter(raw)
        left, singular, right = mpmath.svd_r(parameter)
        sign = 1 if mpmath.det(left) * mpmath.det(right) > 0 else -1
        first, second, third = singular[0], singular[1], sign * singular[2]
        rotation = _rotation(*(mpmath.mpf(float(angle)) for angle in value))
        trace = sum(parameter[i, j] * rotation[i, j] for i in range(3) for j in range(3))
        falls = [float(2 * pair) for pair in (second + third, first + third, first + second)]
        volume = mpmath.log(abs(mpmath.cos(mpmath.mpf(float(value[1])))) / (8 * mpmath.pi**2))
        return float(trace - (first + second + third) - log_constant(*falls) + volume)


def log_constant(first: float, second: float, third: float) -> float:
    """Return log(c(F) exp(-tr S)), with the normaliser c(F), by the integral of Lee 2018, eq. 12, with u = 1 - 2w.

    S = diag(s₁, s₂, s₃) holds the proper singular values of F. The arguments are λ₁ = 2(s₂+s₃), λ₂ = 2(s₁+s₃) and λ₃ =
    2(s₁+s₂), which `framework.geometry.aligned_rotations` calls falls.

    The integral is computed by Gauss-Legendre quadrature on panels that become shorter towards both ends, by a factor
    of ten for every two panels. The components of the quaternion are paired as (q₀, q₃) and (q₁, q₂), unlike in the
    framework's own quadrature.
    """
    borders = np.concatenate([[0.0], np.logspace(-40, np.log10(0.5), 80)])
    nodes, weights = np.polynomial.legendre.leggauss(24)
    half = np.diff(borders)[:, None] / 2
    near = (borders[:-1, None] + half * (nodes + 1)).ravel()  # values of w, and in the second pass of 1 - w
    weight = (half * weights).ravel()
    total = 0.0
    for w, rest in ((near, 1 - near), (1 - near, near)):
        bessels = special.i0e((second - first) / 2 * w) * special.i0e(third / 2 * rest)
        total += (weight * np.exp(-first * w) * bessels).sum()
    return float(np.log(total))


def _parameter(raw: np.ndarray) -> Any:
    """Return F for raw parameters, as the head's docstring defines it."""
    matrix = mpmath.matrix(raw.tolist())
    square = sum(number**2 for number in matrix)
    if square == 0:
        return matrix
    growth = mpmath.power(1 + square / 16, mpmath.mpf(3) / 2)
    return matrix * min(growth, LARGEST_PARAMETER / mpmath.sqrt(square))


def _rotation(azimuth: Any, elevation: Any, tilt: Any) -> Any:
    def about_z(angle: Any) -> Any:
        cosine, sine = mpmath.cos(angle), mpmath.sin(angle)
        return mpmath.matrix([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])

    cosine, sine = mpmath.sin(elevation), -mpmath.cos(elevation)
    return (
        about_z(tilt) * mpmath.matrix([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]]) * about_z(-azimuth)
    )


def cases(head: DensityHead) -> Iterator[Case]:
    """Yield a case for every matrix of raw parameters, at a few viewpoints.

    Some viewpoints have an elevation outside of ±π/2, or angles of many full rotations.
    """
    for name, matrix in RAWS.items():
        raw = torch.tensor(matrix.ravel()).float().double().expand(len(VALUES), 9)
        value = torch.tensor(VALUES).float().double()
        log_prob = [exact(raw[0].view(3, 3).numpy(), row) for row in value.numpy()]
        yield Case(name, raw, value, torch.tensor(log_prob, dtype=torch.float64))


ROWS = {
    "matrix_fisher": (
        HeadRow(
            "azimuth, elevation, tilt",
            TARGET,
            cases=cases,
            leave_out={
                "mode": "the mode is the likeliest rotation; the highest point in the chart differs, because of cos e",
                "tempered: power": "only the density of rotations is raised to the power, not the chart's cos e",
            },
        ),
    )
}
