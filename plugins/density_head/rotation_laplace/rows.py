"""Contract-test cases: the rotation Laplace head, with normalisers by quadrature over rotations in NumPy."""

from collections.abc import Iterator
from functools import cache

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from framework.density_head import DensityHead
from framework.heads.rotations import ANGLES
from framework.target import Target
from framework.testing.rows import Case, HeadRow
from plugins.density_head.rotation_laplace.functions import SOFTENING

TARGET = Target("angle", ANGLES)
GENERIC = [[0.5, -1.25, 0.75], [2.0, 0.125, -0.5], [0.25, 1.5, -1.0]]
VALUES = [[0.3, 0.2, -0.1], [2.5, -1.2, 3.0], [-1.0, 1.5, 0.7], [4.0, 2.0, -5.0]]
RAWS = {
    "A = 0": np.zeros((3, 3)),
    "small": 1e-3 * np.array(GENERIC),
    "generic": np.array(GENERIC),
    "generic, large": 2 * np.array(GENERIC),
    "equal singular values": np.diag([2.0, 2.0, 2.0]),
    "equal, s₃ = -s₂": np.diag([2.0, 2.0, -2.0]),
    "rank one": np.diag([0.0, 4.0, 0.0]),
}


def graded(length: float, ends: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights of Gauss-Legendre panels on [0, length] that become shorter towards one or both ends."""
    half = length / ends
    border = np.concatenate([[0.0], np.logspace(-7, 0, 22) * half])
    node, weight = np.polynomial.legendre.leggauss(8)
    middle = np.diff(border)[:, None] / 2
    points, mass = (border[:-1, None] + middle * (node + 1)).ravel(), (middle * weight).ravel()
    if ends == 1:
        return points, mass
    return np.concatenate([points, length - points]), np.concatenate([mass, mass])


@cache
def log_normaliser(falls: tuple[float, ...]) -> float:
    """Return log F by a quadrature over quaternions (cos α, sin α n) with a unit vector n.

    d² = δ² + sin²α Σ λᵢnᵢ², and the invariant measure is (2/π) sin²α dα, 0 ≤ α ≤ π, times the uniform one of n.
    Both halves of the range of α, and all octants of n, are equal.
    """
    alpha, mass = graded(np.pi / 2, 1)
    height, height_mass = graded(1.0, 2)
    turn, turn_mass = graded(np.pi / 2, 2)
    across = 1 - height[:, None] ** 2
    form = falls[0] * height[:, None] ** 2 + across * (
        falls[1] * np.cos(turn) ** 2 + falls[2] * np.sin(turn) ** 2
    )
    total = 0.0
    for angle, share in zip(alpha, mass, strict=True):
        distance = np.sqrt(SOFTENING**2 + np.sin(angle) ** 2 * form)
        mean = height_mass @ (np.exp(-distance) / distance) @ turn_mass / (np.pi / 2)
        total += share * (4 / np.pi) * np.sin(angle) ** 2 * mean
    return float(np.log(total))


def cases(head: DensityHead) -> Iterator[Case]:
    """Yield a case for every matrix of raw parameters, at some viewpoints, two of which have elevations beyond ±π/2."""
    for name, matrix in RAWS.items():
        parameter = matrix * (1 + (matrix**2).sum() / 16) ** 1.5
        singular = np.linalg.svd(parameter, compute_uv=False)
        singular[2] *= -1 if np.linalg.det(parameter) < 0 else 1
        first, second, third = singular
        constant = log_normaliser((2 * (second + third), 2 * (first + third), 2 * (first + second)))
        value = np.array(VALUES, dtype=np.float32).astype(np.float64)
        azimuth, elevation, tilt = value.T
        rotation = Rotation.from_euler(
            "ZXZ", np.stack([tilt, elevation - np.pi / 2, -azimuth], 1)
        ).as_matrix()
        square = singular.sum() - (parameter * rotation).sum((1, 2)) + SOFTENING**2
        distance = np.sqrt(square)
        volume = np.log(np.abs(np.cos(elevation)) / (8 * np.pi**2))
        log_prob = volume - distance - np.log(distance) - constant
        raw = torch.from_numpy(matrix.ravel()).float().double().expand(len(VALUES), 9)
        yield Case(name, raw, torch.from_numpy(value), torch.from_numpy(log_prob))


ROWS = {
    "rotation_laplace": (
        HeadRow(
            "azimuth, elevation, tilt",
            TARGET,
            cases=cases,
            scale=0.1,
            limits={"log_prob, float64": 1e-8},  # the error of the normaliser
            leave_out={
                "marginals": "a fixed grid does not resolve the tip; test_rotation_laplace.py checks them",
                "mode": "the mode is the likeliest rotation; the highest point in the chart differs, because of cos e",
            },
        ),
    )
}
