"""Parts that density heads of rotations share: the check of the target, and the matrix from raw parameters."""

import torch
from jaxtyping import Float
from torch import Tensor

from framework.errors import ConfigError
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

    F = X near 0, and |F| grows with the fourth power: |X| = 27 already gives |F| = 1e4, and no gradient explodes. The
    function is smooth at 0, since it reads only |X|².
    """
    raw = raw.double().clamp(-1e100, 1e100)  # so that squares do not overflow
    square = raw.square().sum((-2, -1), keepdim=True)
    growth = (1 + square / 16) ** 1.5
    # where the bound applies, the norm is at least 1; the clamp avoids the square root at 0, which has no gradient
    return raw * torch.minimum(growth, largest / square.clamp(min=1).sqrt())
