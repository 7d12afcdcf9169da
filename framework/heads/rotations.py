"""Parts that density heads of rotations share: the check of the target, and heads that read a matrix."""

import math
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from framework.density_head import DensityHead
from framework.errors import ConfigError
from framework.geometry import quaternions
from framework.geometry.rotation_grid import distant_rotations
from framework.heads.parameters import require_finite
from framework.heads.viewpoints import MatrixDensity
from framework.target import Target

ANGLES = ("azimuth", "elevation", "tilt")
"""Names of the angles that describe a rotation."""


def require_rotation(target: Target, by: str) -> None:
    """Refuse a target that is not azimuth, elevation and tilt, in this order; `by` is the name of the head.

    Raises:
        ConfigError: the target is another one.
    """
    target.require("angle", by=f"density_head {by}")
    if target.names != ANGLES:
        raise ConfigError(
            f"density_head {by} describes rotations by the three angles {', '.join(ANGLES)}, in this order, but the "
            f"targets of this data set are {target.listed_names}. Choose another density_head, or other data; "
            "density_head=von_mises describes any angles."
        )


def grown_matrix(raw: Float[Tensor, "*batch 3 3"], largest: float) -> Float[Tensor, "*batch 3 3"]:
    """Return F = X (1 + |X|²/16)^(3/2) for the raw matrix X, float64, at most `largest` in the Frobenius norm |F|.

    F is about X near 0, and |F| grows with the fourth power of |X|: |X| = 27 already gives |F| = 1e4, and no gradient
    explodes. The function is smooth at 0, since it reads only |X|².
    """
    raw = raw.double().clamp(-1e100, 1e100)  # so that squares do not overflow
    square = raw.square().sum((-2, -1), keepdim=True)
    growth = (1 + square / 16) ** 1.5
    # where the bound applies, the norm is at least 1; the clamp avoids the square root at 0, which has no gradient
    return raw * torch.minimum(growth, largest / square.clamp(min=1).sqrt())


class MatrixHead(DensityHead):
    """Base of heads that read the nine elements of a matrix X, row by row, for one density with a matrix as parameter.

    The parameter is a multiple of X that grows faster than X (`grown_matrix`). X = 0 gives the uniform density
    of rotations, without a special case.

    Raises:
        ConfigError: the target is not azimuth, elevation and tilt, in this order.
    """

    by: ClassVar[str]
    """Name of the head, for messages."""
    density: ClassVar[type[MatrixDensity]]
    """Class of the densities."""
    largest: ClassVar[float]
    """Largest Frobenius norm of the parameter."""

    def __init__(self, target: Target) -> None:
        super().__init__()
        require_rotation(target, self.by)
        self.size = 9

    def forward(self, raw: Float[Tensor, "*batch size"]) -> MatrixDensity:
        raw = require_finite(raw, self.size)
        return self.density(grown_matrix(raw.unflatten(-1, (3, 3)), self.largest), raw.dtype)

    def component_offsets(self, count: int) -> Float[Tensor, "count 9"]:
        """Return √3 R for `count` rotations R that are far from one another, all turned by one random rotation.

        Independent numbers from N(0, 1) would leave large gaps between the modes, and most of the matrices would give
        densities that are wide about one axis. The squared norm |√3 R|² = 9 is the mean
        squared norm of nine independent numbers from N(0, 1).
        """
        turn = torch.nn.functional.normalize(torch.randn(4), dim=0).double()
        spread = quaternions.product(turn, distant_rotations(count))
        matrices = quaternions.matrix_less_identity(spread) + torch.eye(3, dtype=torch.float64)
        return (math.sqrt(3) * matrices).flatten(1).to(torch.get_default_dtype())
