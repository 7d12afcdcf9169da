"""Fits Lorentzian lines to many Z-spectra at once, and says how sure of each parameter it is."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.normals import JointNormal
from framework.least_squares.solution import Solution, Status
from framework.least_squares.solver import least_squares
from framework.spectra.spectrum import COUNT, Misfit, Parameters

CUT = 10.0
"""Beyond this a measured number is no Z, which lies between 0 and about 1, and is cut off."""
DECREASE = 1e-10
"""Newton's last step leaves the square of the share of the cost that it gains."""
CAREFUL, BOLD = 1e-1, 1e-3
"""Damping at the first step from the preset's start, and from one that is near."""
DOUBTFUL = 1e-4
"""Least pivot of a scaled inverse covariance from which its factor has eight right digits."""
LEAST_SHARE = 1e-9
"""The least standard error, in sides of the box: of a spectrum without noise."""


class Fit(NamedTuple):
    """Attributes:
    parameters: (spectrum, p), all that were fitted.
    root: (spectrum, p, p), lower Cholesky factor of their covariance.
    cost: (spectrum,), half the sum of squared residuals.
    status: (spectrum,), of framework.least_squares.solution.Status.
    """

    parameters: Float[Tensor, "spectrum p"]
    root: Float[Tensor, "spectrum p p"]
    cost: Float[Tensor, "spectrum"]
    status: Int[Tensor, "spectrum"]


def fit(
    measured: Float[Tensor, "spectrum offset"],
    offsets: Float[Tensor, "offset"],
    wanted: Parameters,
    start: Float[Tensor, "spectrum p"] | None = None,
    most: int = 300,
) -> Fit:
    """Least squares of each spectrum, from the preset's start or a given one.

    The covariance is that of the Jacobian J with the residuals' variance s², and of a box whose sides u - l say no more
    than a uniform density does: (JᵀJ / s² + diag 12 / (u - l)²)⁻¹. Where the data determine a parameter the second term
    is nothing; where they do not (a pool without amplitude has no width) the first is, and the parameter may be
    anywhere in its box.

    Where a pool has vanished (amplitude 0), it has no width that could lead it back: such spectra are fitted once more
    from another start, and the better fit is kept. So are all where centres are free, unless a start is given: the line
    of amide may be the sharp or the broad one of two (benchmarks/spectra/cest.md counts how often that matters).

    Args:
        measured: NaN where nothing was measured.
        start: (spectrum, p), or without the parameters that are no target.
        most: steps tried.
    """
    device = measured.device
    measured = measured.detach().cpu().double().clamp(-CUT, CUT)
    offsets = offsets.to(measured)
    lower, upper, first, second = (
        measured.new_tensor(side) for side in (wanted.lower, wanted.upper, wanted.start, wanted.elsewhere)
    )
    begin, damping = first.expand(len(measured), -1), CAREFUL
    if start is not None:
        given = start.detach().to(begin)
        given = given.where(given.isfinite(), begin[:, : given.shape[1]])
        begin, damping = torch.cat((given, begin[:, given.shape[1] :]), 1), BOLD

    def search(measured: Tensor, begin: Tensor, damping: float) -> Solution:
        misfit = Misfit(measured, offsets)
        return least_squares(
            misfit,
            begin,
            lower,
            upper,
            normal=misfit.normal,
            curvature=misfit.curvature,
            most=most,
            decrease=DECREASE,
            damping=damping,
        )

    found = search(measured, begin, damping)
    parameters, cost, status = found.parameters, found.cost, found.status
    again = status == Status.ILL_POSED
    if start is None and wanted.told > 2 * COUNT:
        again = status != Status.NOT_FINITE
    if len(lost := again.nonzero().squeeze(1)):
        again = search(measured[lost], second.expand(len(lost), -1), CAREFUL)
        better = again.cost < cost[lost]
        kept = lost[better]
        parameters[kept], cost[kept] = again.parameters[better], again.cost[better]
        status[kept] = again.status[better]
    root = _root(Misfit(measured, offsets), parameters, upper - lower)
    return Fit(*(part.to(device) for part in (parameters, root, cost, status)))


def _root(misfit: Misfit, parameters: Tensor, sides: Tensor) -> Tensor:
    """The covariance's Cholesky factor; of sides of the box, in which numbers are of one size."""
    size = parameters.shape[1]
    rows = torch.arange(len(parameters))
    cost, _, gram, there = misfit.normal(parameters, rows)
    variance = (2 * cost / (there - size).clamp(min=1)).clamp(min=LEAST_SHARE**2)
    # of the inverse covariance A = Uᵀ U with a lower triangle U, so that U⁻¹ is the lower factor of A⁻¹
    precision = gram * (sides.unsqueeze(-1) * sides) / variance[:, None, None]
    precision.diagonal(dim1=-2, dim2=-1).add_(12)
    length = precision.diagonal(dim1=-2, dim2=-1).sqrt()
    scaled = precision / (length.unsqueeze(-1) * length.unsqueeze(-2))
    upper, failed = torch.linalg.cholesky_ex(scaled.flip(-1, -2))
    triangle = upper.flip(-1, -2).mT
    doubtful = ((failed > 0) | ~(upper.diagonal(dim1=-2, dim2=-1).amin(-1) > DOUBTFUL)).nonzero().squeeze(1)
    identity = torch.eye(size, dtype=parameters.dtype)
    triangle[doubtful] = identity
    root = torch.linalg.solve_triangular(triangle, identity.expand_as(triangle), upper=False)
    root = root / length.unsqueeze(-1)
    if len(doubtful):
        root[doubtful] = _careful_root(
            misfit, parameters[doubtful], rows[doubtful], variance[doubtful], sides
        )
    return sides.unsqueeze(-1) * root


def _careful_root(
    misfit: Misfit, parameters: Tensor, rows: Tensor, variance: Tensor, sides: Tensor
) -> Tensor:
    """The same with the Jacobian itself, whose square has lost digits."""
    size = parameters.shape[1]
    residuals, jacobian = misfit(parameters, rows)
    jacobian = jacobian.where(~residuals.isnan().unsqueeze(-1), 0.0) * sides
    # triangle R with RᵀR = JᵀJ + 12 s²; the covariance is s² R⁻¹ R⁻ᵀ, whose factor follows from another triangle
    identity = torch.eye(size, dtype=parameters.dtype)
    prior = (12 * variance).sqrt()[:, None, None] * identity
    triangle = torch.linalg.qr(torch.cat((jacobian, prior), 1), mode="r").R
    inverse = torch.linalg.solve_triangular(triangle, identity.expand_as(triangle), upper=True)
    lower = torch.linalg.qr(inverse.mT, mode="r").R.mT * variance.sqrt()[:, None, None]
    return lower * lower.diagonal(dim1=-2, dim2=-1).sign().unsqueeze(-2)


def density(found: Fit, told: int, shape: torch.Size | tuple[int, ...], zero: Tensor) -> Distribution:
    """The Gaussian over the first `told` parameters, of the type of `zero` (*shape, 1), which is added to its mean: of
    a lower Cholesky factor the first rows are their marginal's."""
    mean = found.parameters[:, :told].reshape(*shape, told).to(zero) + zero
    return JointNormal(mean, found.root[:, :told, :told].reshape(*shape, told, told).to(zero))
