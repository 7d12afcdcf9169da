"""The rotation Laplace head, which turns nine raw parameters into one density over viewpoints."""

import torch
from jaxtyping import Float
from torch import Tensor

from framework.density_head import DensityHead
from framework.errors import ConfigError
from framework.heads.parameters import require_finite
from framework.target import Target
from plugins.density_head.rotation_laplace.density import RotationLaplace

ANGLES = ("azimuth", "elevation", "tilt")
LARGEST_PARAMETER = 1e6
"""Largest Frobenius norm of A, for typical deviations of about 0.1°; float64 resolves d down to δ there."""


class RotationLaplaceHead(DensityHead):
    """One rotation Laplace density of azimuth, elevation and tilt, which has heavier tails than matrix Fisher.

    The head reads the nine elements of a matrix X, row by row, and A is a multiple of X that grows faster than X
    (`parameter_of_raw`). In Yin et al. 2023, Def. 3, A = X. The uniform density of rotations is X = 0.

    Raises:
        ConfigError: the target is not azimuth, elevation and tilt, in this order.
    """

    bibtex = "yin2023laplace"

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("angle", by="density_head rotation_laplace")
        if target.names != ANGLES:
            raise ConfigError(
                f"density_head rotation_laplace describes rotations by the three angles {', '.join(ANGLES)}, in this "
                f"order, but the targets of this data set are {target.listed_names}. Choose another density_head, or "
                "other data; density_head=von_mises describes any angles."
            )
        self.size = 9

    def forward(self, raw: Float[Tensor, "*batch size"]) -> RotationLaplace:
        raw = require_finite(raw, self.size)
        return RotationLaplace(parameter_of_raw(raw.unflatten(-1, (3, 3))), raw.dtype)


def parameter_of_raw(raw: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return A = X (1 + |X|²/16)^(3/2), float64, at most LARGEST_PARAMETER in the Frobenius norm |A|.

    A = X near 0, and |A| grows with the fourth power. The function is smooth at 0, since it reads only |X|².
    """
    raw = raw.double().clamp(-1e100, 1e100)  # so that squares do not overflow
    square = raw.square().sum((-2, -1), keepdim=True)
    growth = (1 + square / 16) ** 1.5
    # where the bound applies, the norm is at least 1; the clamp avoids the square root at 0, which has no gradient
    return raw * torch.minimum(growth, LARGEST_PARAMETER / square.clamp(min=1).sqrt())
