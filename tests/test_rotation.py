"""Viewpoint rotations and geodesic distances, compared with SciPy."""

import math

import numpy as np
import pytest
import torch
from scipy.linalg import logm
from scipy.spatial.transform import Rotation

from framework.geometry.rotation import geodesic_distance, viewpoint_rotation


def test_rotation_is_the_zxz_product() -> None:
    angles = torch.randn(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for angle, found in zip(angles.numpy(), viewpoint_rotation(angles).numpy(), strict=True):
        azimuth, elevation, tilt = angle
        wanted = Rotation.from_euler("ZXZ", [tilt, elevation - math.pi / 2, -azimuth]).as_matrix()
        np.testing.assert_allclose(found, wanted, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.5, 1.8, 2.0, 3.0, 3.14, math.pi - 1e-6, math.pi])
def test_distance_is_the_angle_of_the_rotation_between(angle: float) -> None:
    generator = np.random.default_rng(3)
    for _ in range(20):
        axis = generator.normal(size=3)
        first = Rotation.random(rng=generator)
        second = first * Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
        found = geodesic_distance(torch.from_numpy(first.as_matrix()), torch.from_numpy(second.as_matrix()))
        assert abs(found.item() - angle) < 2e-15 + 1e-14 * angle


def test_distance_is_the_norm_of_the_matrix_logarithm() -> None:
    first, second = (
        viewpoint_rotation(torch.tensor(a, dtype=torch.float64)) for a in ([0.3, 0.2, -0.1], [2.0, 0.5, 0.4])
    )
    wanted = np.linalg.norm(logm(first.numpy().T @ second.numpy()), "fro") / math.sqrt(2)
    assert abs(geodesic_distance(first, second).item() - wanted) < 1e-12
