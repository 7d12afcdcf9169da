"""The matrix Fisher head, which turns nine raw parameters into one density over viewpoints."""

from framework.heads.rotations import MatrixHead
from plugins.density_head.matrix_fisher.density import MatrixFisher

LARGEST_PARAMETER = 1e12
"""Largest Frobenius norm of F; it gives standard deviations of a microradian, the resolution of float32 angles."""


class MatrixFisherHead(MatrixHead):
    """One joint matrix Fisher density of azimuth, elevation and tilt, through the rotation that they describe.

    The thesis leaves this joint density to future work (§3.7). The network is as in Mohlin et al. 2020.

    The head reads the nine elements of a matrix X, row by row. The parameter F of the density (`MatrixFisher`) is a
    multiple of X that grows faster than X (`grown_matrix`). F is the density's natural parameter, so that the uniform
    density of rotations, X = 0, needs no special case.

    Raises:
        ConfigError: the target is not azimuth, elevation and tilt, in this order.
    """

    bibtex = "mohlin2020probabilistic"
    by = "matrix_fisher"
    density = MatrixFisher
    largest = LARGEST_PARAMETER
