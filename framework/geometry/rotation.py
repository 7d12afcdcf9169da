"""Rotation matrices of viewpoints, and the geodesic distance between them."""

import torch
from jaxtyping import Float
from torch import Tensor


def viewpoint_rotation(angles: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation from object to camera of viewpoints `angles`: Rz(t) Rx(e - π/2) Rz(-a).

    The angles are azimuth a, elevation e and tilt t, radians. This is the Euler convention of PASCAL3D+ annotations
    (Xiang et al., WACV 2014), as used for viewpoint evaluation by Tulsiani & Malik (CVPR 2015). The camera frame has x
    right, y up, z towards the viewer.
    """
    azimuth, elevation, tilt = angles.unbind(-1)
    return about_z(tilt) @ _about_x_elevation(elevation) @ about_z(-azimuth)


def geodesic_distance(
    first: Float[Tensor, "*batch 3 3"], second: Float[Tensor, "*batch 3 3"]
) -> Float[Tensor, "*batch"]:
    """Return the angle between two rotations R₁ and R₂, radians in [0, π]: ||log(R₁ᵀR₂)||_F / √2 (Tulsiani & Malik).

    The angle is accurate near 0, where the arc cosine of the trace of R₁ᵀR₂ would lose half the digits. The angle is
    accurate near π too, where cos(angle / 2), if computed from the trace, would also lose half the digits. For angles
    above 2π/3 this cosine is sin(angle) / (2 sin(angle / 2)), with sin(angle) from the antisymmetric part of R₁ᵀR₂.
    """
    chord = torch.linalg.matrix_norm(first - second) / 8**0.5  # sin(angle / 2)
    trace = (first * second).sum((-2, -1))
    wide = trace < 0
    between = first.mT @ second
    sine = torch.linalg.matrix_norm(between - between.mT) / 8**0.5
    cosine = torch.where(wide, sine / (2 * chord.clamp(min=0.5)), ((1 + trace.where(~wide, 0)) / 4).sqrt())
    return 2 * torch.atan2(chord, cosine)


def about_z(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation by `angle`, radians, about the third axis, counter-clockwise seen from its positive end."""
    cos, sin, zeros, ones = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    rows = torch.stack([cos, -sin, zeros, sin, cos, zeros, zeros, zeros, ones], -1)
    return rows.unflatten(-1, (3, 3))


def _about_x_elevation(elevation: Tensor) -> Tensor:
    # Rx(e - π/2) with cos(e - π/2) = sin e and sin(e - π/2) = -cos e, exact in any precision.
    cos, sin = elevation.sin(), -elevation.cos()
    zeros, ones = torch.zeros_like(cos), torch.ones_like(cos)
    rows = torch.stack([ones, zeros, zeros, zeros, cos, -sin, zeros, sin, cos], -1)
    return rows.unflatten(-1, (3, 3))
