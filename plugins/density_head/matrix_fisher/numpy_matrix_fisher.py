"""Matrix Fisher densities of viewpoints, for exported models, computed with NumPy alone."""

import math

import numpy as np

from framework.distributions.numpy_densities import Array, Density, bessel_i0e, wrap

_REACH, _PANEL = 44.0, 4.0
_NODES = [np.polynomial.legendre.leggauss(count) for count in (64, 48)]
_ROUNDS = 96
"""Largest number of proposals for a draw; at least 45 % are accepted."""


class MatrixFisher(Density):
    """Azimuth, elevation and tilt of a rotation R with density exp(tr(FᵀR)) / c(F).

    The density is with respect to azimuth, elevation and tilt in the chart with elevations from -π/2 to π/2. Medians
    and intervals are computed from random draws. The mode is the likeliest rotation. The comments of
    framework/geometry/aligned_rotations.py explain the formulas.

    Args:
        parameter: F, (*batch, 3, 3).
    """

    circular = True
    by_draws = True

    def __init__(self, parameter: Array) -> None:
        self.batch, self.event = parameter.shape[:-2], (3,)
        left, singular, right = np.linalg.svd(parameter)
        right = np.swapaxes(right, -1, -2)
        flips = [np.sign(np.linalg.det(basis)) for basis in (left, right)]
        last = np.array([0.0, 0.0, 1.0])
        left, right = (
            basis * (1 - last + last * flip[..., None, None])
            for basis, flip in zip((left, right), flips, strict=True)
        )
        first, second, third = np.moveaxis(singular, -1, 0)
        third = third * flips[0] * flips[1]
        self.falls = np.maximum(2 * np.stack([second + third, first + third, first + second], -1), 0)
        self.left, self.right = _of_matrix(left), _of_matrix(right)

    def log_prob(self, value: Array) -> Array:
        turn = _product(_product(_inverse(self.left), _of_viewpoint(value)), self.right)
        with np.errstate(divide="ignore"):
            volume = np.log(np.abs(np.cos(value[..., 1]))) - math.log(8 * math.pi**2)
        return volume - (self.falls * turn[..., 1:] ** 2).sum(-1) - self._log_constant()

    def _log_constant(self) -> Array:
        """Return log(c(F) exp(-tr S)), (*batch), where S is the diagonal matrix of the proper singular values of F."""
        first, second, third = (self.falls[..., index, None] for index in range(3))
        end = _REACH / np.maximum(second, _REACH)
        stretch = (third - second) / 2
        start = 1 / np.sqrt(1 + stretch * end)
        length = np.arcsinh(1 / start)
        border = np.maximum(length - _PANEL, 0)
        (early, early_weight), (late, late_weight) = (
            ((nodes + 1) / 2, weights / 2) for nodes, weights in _NODES
        )
        y = np.concatenate([border * early, border + (length - border) * late], -1)
        weight = np.concatenate([border * early_weight, (length - border) * late_weight], -1)
        root = start * np.sinh(y)
        w = end * root * root
        slope = 2 * end * root * start * np.cosh(y)
        bessels = bessel_i0e(stretch * w) * bessel_i0e(first / 2 * (1 - w))
        return np.log((weight * slope * np.exp(-second * w) * bessels).sum(-1))

    def sample(self, generator: np.random.Generator, count: int) -> Array:
        falls = np.concatenate([np.zeros((*self.batch, 1)), self.falls], -1)
        width = np.ones((*self.batch, 1))
        for _ in range(40):  # Newton's method, from the left
            parts = 1 / (width + 2 * falls)
            width = width + (parts.sum(-1, keepdims=True) - 1) / (parts**2).sum(-1, keepdims=True)
        width = np.clip(width, 1, 4)
        turns = np.zeros((count, *self.batch, 4))
        open_ = np.ones((count, *self.batch), bool)
        for _ in range(_ROUNDS):
            normal = generator.standard_normal(turns.shape) / np.sqrt(1 + 2 * falls / width)
            proposal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
            cost, size = (falls * proposal**2).sum(-1), width[..., 0]
            ratio = -cost + 2 * np.log1p(2 * cost / size) + (4 - size) / 2 - 2 * np.log(4 / size)
            turns = np.where(open_[..., None], proposal, turns)
            open_ &= np.log(generator.random(cost.shape)) >= ratio
            if not open_.any():
                break
        return _viewpoint(_product(_product(self.left, turns), _inverse(self.right)))

    def mode(self) -> Array:
        return _viewpoint(_product(self.left, _inverse(self.right)))


def _product(first: Array, second: Array) -> Array:
    """Return the product of quaternions (..., 4)."""
    a, b, c, d = np.moveaxis(first, -1, 0)
    e, f, g, h = np.moveaxis(second, -1, 0)
    return np.stack(
        [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ],
        -1,
    )


def _inverse(turn: Array) -> Array:
    return turn * np.array([1.0, -1.0, -1.0, -1.0])


def _of_viewpoint(angles: Array) -> Array:
    """Return the quaternions of azimuth, elevation and tilt, (..., 4)."""
    azimuth, elevation, tilt = np.moveaxis(angles, -1, 0)
    half, total, difference = elevation / 2 - math.pi / 4, (tilt + azimuth) / 2, (tilt - azimuth) / 2
    cosine, sine = np.cos(half), np.sin(half)
    parts = [
        cosine * np.cos(difference),
        sine * np.cos(total),
        sine * np.sin(total),
        cosine * np.sin(difference),
    ]
    return np.stack(parts, -1)


def _viewpoint(turn: Array) -> Array:
    """Return azimuth, elevation and tilt of quaternions, (..., 3)."""
    real, x, y, z = np.moveaxis(turn, -1, 0)
    elevation = math.pi / 2 - 2 * np.arctan2(np.hypot(x, y), np.hypot(real, z))
    difference, total = np.arctan2(z, real), np.arctan2(-y, -x)
    return np.stack([wrap(total - difference), elevation, wrap(total + difference)], -1)


def _of_matrix(matrix: Array) -> Array:
    """Return the quaternions of rotation matrices, (..., 4)."""
    (a, b, c), (d, e, f), (g, h, i) = (np.moveaxis(row, -1, 0) for row in np.moveaxis(matrix, -2, 0))
    rows = np.stack(
        [
            np.stack([1 + a + e + i, h - f, c - g, d - b], -1),
            np.stack([h - f, 1 + a - e - i, b + d, c + g], -1),
            np.stack([c - g, b + d, 1 - a + e - i, f + h], -1),
            np.stack([d - b, c + g, f + h, 1 - a - e + i], -1),
        ],
        -2,
    )
    best = np.diagonal(rows, axis1=-2, axis2=-1).argmax(-1)
    row = np.take_along_axis(rows, best[..., None, None], -2)[..., 0, :]
    return row / np.linalg.norm(row, axis=-1, keepdims=True)


FAMILIES = {"matrix_fisher": MatrixFisher}
