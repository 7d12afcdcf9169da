"""The matrix Fisher head, which turns nine raw parameters into one density over viewpoints."""

import torch
from jaxtyping import Float
from torch import Tensor

from framework.density_head import DensityHead
from framework.errors import ConfigError
from framework.heads.parameters import require_finite
from framework.target import Target
from plugins.density_head.matrix_fisher.density import MatrixFisher

ANGLES = ("azimuth", "elevation", "tilt")
LARGEST_PARAMETER = 1e12
"""Largest Frobenius norm of F, for standard deviations of a microradian, which is the resolution of float32 angles."""


class MatrixFisherHead(DensityHead):
    """One joint matrix Fisher density of azimuth, elevation and tilt, through the rotation that they describe.

    The thesis leaves this joint density to future work (§3.7). The network is as in Mohlin et al. 2020.

    The head reads the nine elements of a matrix X, row by row. F is a multiple of X that grows faster than X
    (`parameter_of_raw`). F is the density's natural parameter, so that the uniform density of rotations, X = 0, needs
    no special case.

    Raises:
        ConfigError: the target is not azimuth, elevation and tilt, in this order.
    """

    bibtex = "mohlin2020probabilistic"

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("angle", by="density_head matrix_fisher")
        if target.names != ANGLES:
            raise ConfigError(
                f"density_head matrix_fisher describes rotations by the three angles {', '.join(ANGLES)}, in this "
                f"order, but the targets of this data set are {target.listed_names}. Choose another density_head, or "
                "other data; density_head=von_mises describes any angles."
            )
        self.size = 9

    def forward(self, raw: Float[Tensor, "*batch size"]) -> MatrixFisher:
        raw = require_finite(raw, self.size)
        return MatrixFisher(parameter_of_raw(raw.unflatten(-1, (3, 3))), raw.dtype)


def parameter_of_raw(raw: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return F = X (1 + |X|²/16)^(3/2), float64, at most LARGEST_PARAMETER in the Frobenius norm |F|.

    F = X near 0, and |F| grows with the fourth power: |X| = 27 already gives a concentration of 1e4, and no gradient
    explodes. The function is smooth at 0, since it reads only |X|².
    """
    raw = raw.double().clamp(-1e100, 1e100)  # so that squares do not overflow
    square = raw.square().sum((-2, -1), keepdim=True)
    growth = (1 + square / 16) ** 1.5
    # where the bound applies, the norm is at least 1; the clamp avoids the square root at 0, which has no gradient
    return raw * torch.minimum(growth, LARGEST_PARAMETER / square.clamp(min=1).sqrt())
