"""Errors of a body's rotation and translation, and the content of the figure for one image."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from framework.bodies.body import rotation_minus_identity
from framework.geometry.rotation import geodesic_distance

NEAR = (2.0, 1.0)
"""Errors in degrees and centimetres up to which a body counts as found."""


class FittedImage(NamedTuple):
    """Content of the figure for one sample.

    Attributes:
        start, target, end: images, (height, width, 3), linear RGB.
        degrees, centimetres: error of rotation and translation at the end.
        path: one row for each accepted step: loss, processor time (seconds), degrees, centimetres.
    """

    start: Tensor
    target: Tensor
    end: Tensor
    degrees: float
    centimetres: float
    path: Tensor


def place_errors(
    predicted: Float[Tensor, "*batch number"], true: Float[Tensor, "*#batch number"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Return the angle between two rotations, degrees, and the distance between two translations, cm, float64.

    The first three numbers of a target are the rotation, axis times angle, and the next three the translation, metres.
    """
    predicted, true = predicted.double(), true.double().expand_as(predicted)
    predicted_rotation, true_rotation = (
        rotation_minus_identity(numbers[..., :3]) + torch.eye(3, dtype=torch.float64, device=numbers.device)
        for numbers in (predicted, true)
    )
    distance = torch.linalg.vector_norm(predicted[..., 3:6] - true[..., 3:6], dim=-1)
    return torch.rad2deg(geodesic_distance(predicted_rotation, true_rotation)), 100 * distance
