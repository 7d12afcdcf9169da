"""The rotation Laplace head, which turns nine raw parameters into one density over viewpoints."""

from framework.heads.rotations import MatrixHead
from plugins.density_head.rotation_laplace.density import RotationLaplace

LARGEST_PARAMETER = 1e6
"""Largest Frobenius norm of A. With this norm, typical deviations are about 0.1°, and float64 resolves d down to δ."""


class RotationLaplaceHead(MatrixHead):
    """One rotation Laplace density of azimuth, elevation and tilt, which has heavier tails than matrix Fisher.

    The head reads the nine elements of a matrix X, row by row, and the parameter A of the density (`RotationLaplace`)
    is a multiple of X that grows faster than X (`grown_matrix`). In Yin et al. 2023, Def. 3, A = X. The uniform density
    of rotations is X = 0.

    Raises:
        ConfigError: the target is not azimuth, elevation and tilt, in this order.
    """

    bibtex = "yin2023laplace"
    by = "rotation_laplace"
    density = RotationLaplace
    largest = LARGEST_PARAMETER
