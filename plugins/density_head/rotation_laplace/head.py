"""The rotation Laplace head, which turns nine raw parameters into one density over viewpoints."""

from jaxtyping import Float
from torch import Tensor

from framework.density_head import DensityHead
from framework.heads.parameters import require_finite
from framework.heads.rotations import grown_matrix, require_rotation
from framework.target import Target
from plugins.density_head.rotation_laplace.density import RotationLaplace

LARGEST_PARAMETER = 1e6
"""Largest Frobenius norm of A, for typical deviations of about 0.1°; float64 resolves d down to δ there."""


class RotationLaplaceHead(DensityHead):
    """One rotation Laplace density of azimuth, elevation and tilt, which has heavier tails than matrix Fisher.

    The head reads the nine elements of a matrix X, row by row, and A is a multiple of X that grows faster than X
    (`grown_matrix`). In Yin et al. 2023, Def. 3, A = X. The uniform density of rotations is X = 0.

    Raises:
        ConfigError: the target is not azimuth, elevation and tilt, in this order.
    """

    bibtex = "yin2023laplace"

    def __init__(self, target: Target) -> None:
        super().__init__()
        require_rotation(target, by="rotation_laplace")
        self.size = 9

    def forward(self, raw: Float[Tensor, "*batch size"]) -> RotationLaplace:
        raw = require_finite(raw, self.size)
        return RotationLaplace(grown_matrix(raw.unflatten(-1, (3, 3)), LARGEST_PARAMETER), raw.dtype)
