"""Rotations as unit quaternions (…, 4), real part first; q and -q are the same rotation.

The functions keep all digits of small rotations. The rotation of a viewpoint is Rz(tilt) Rx(elevation - π/2)
Rz(-azimuth), as in framework.geometry.rotation.viewpoint_rotation.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

Quaternions = Float[Tensor, "... 4"]
"""Unit quaternions; their batch shapes broadcast."""


def product(first: Quaternions, second: Quaternions) -> Quaternions:
    """Return the quaternion of the rotation that rotates by `second` and then by `first`; batch shapes broadcast."""
    a, b, c, d = first.unbind(-1)
    e, f, g, h = second.unbind(-1)
    return torch.stack(
        [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ],
        -1,
    )


def inverse(turn: Quaternions) -> Quaternions:
    """Return the quaternion of the inverse rotation."""
    return torch.cat([turn[..., :1], -turn[..., 1:]], -1)


def about(axis: int, angle: Float[Tensor, "..."]) -> Quaternions:
    """Return the quaternion of the rotation by `angle`, radians, about the axis 1 (x), 2 (y) or 3 (z)."""
    numbers = [torch.zeros_like(angle)] * 4
    numbers[0], numbers[axis] = torch.cos(angle / 2), torch.sin(angle / 2)
    return torch.stack(numbers, -1)


def of_viewpoint(angles: Float[Tensor, "... 3"]) -> Quaternions:
    """Return the quaternion of the rotation with azimuth, elevation and tilt, radians."""
    azimuth, elevation, tilt = angles.unbind(-1)
    half, sum_, difference = elevation / 2 - math.pi / 4, (tilt + azimuth) / 2, (tilt - azimuth) / 2
    cosine, sine = torch.cos(half), torch.sin(half)
    return torch.stack(
        [
            cosine * torch.cos(difference),
            sine * torch.cos(sum_),
            sine * torch.sin(sum_),
            cosine * torch.sin(difference),
        ],
        -1,
    )


def to_viewpoint(turn: Quaternions) -> Float[Tensor, "... 3"]:
    """Return azimuth, elevation and tilt of the rotation with quaternion `turn`, radians.

    Azimuth and tilt are in [-π, π], the elevation is in [-π/2, π/2]. At an elevation of ±π/2 many viewpoints have the
    same rotation, and one of them is returned.
    """
    real, x, y, z = turn.unbind(-1)
    elevation = math.pi / 2 - 2 * torch.atan2(torch.hypot(x, y), torch.hypot(real, z))
    # the inverse of of_viewpoint, whose `sine` is at most 0 and `cosine` at least 0 for elevations in the chart
    difference, sum_ = torch.atan2(z, real), torch.atan2(-y, -x)
    azimuth, tilt = sum_ - difference, sum_ + difference
    turn_ = 2 * math.pi
    azimuth, tilt = (angle - turn_ * torch.round(angle / turn_) for angle in (azimuth, tilt))
    return torch.stack([azimuth, elevation, tilt], -1)


def of_matrix(matrix: Float[Tensor, "... 3 3"]) -> Quaternions:
    """Return the quaternion of a rotation matrix, to full precision at any angle."""
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in matrix.unbind(-2))
    # The rows of 4 q qᵀ are multiples of q; the one with the largest diagonal element, at least 1, is used.
    rows = torch.stack(
        [
            torch.stack([1 + a + e + i, h - f, c - g, d - b], -1),
            torch.stack([h - f, 1 + a - e - i, b + d, c + g], -1),
            torch.stack([c - g, b + d, 1 - a + e - i, f + h], -1),
            torch.stack([d - b, c + g, f + h, 1 - a - e + i], -1),
        ],
        -2,
    )
    best = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = rows.gather(-2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2)
    return row / torch.linalg.vector_norm(row, dim=-1, keepdim=True)


def matrix_less_identity(turn: Quaternions) -> Float[Tensor, "... 3 3"]:
    """Return R - I for the rotation R of a quaternion, without cancellation for small rotations."""
    w, x, y, z = turn.unbind(-1)
    rows = [
        torch.stack([-2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), -2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), -2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)
