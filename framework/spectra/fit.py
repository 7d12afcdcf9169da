"""Fit of Lorentzian lines to many Z-spectra at once, with the covariance of the parameters."""

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
"""Limit to which the absolute values of measured Z are clipped; true values lie between 0 and about 1."""
DECREASE = 1e-10
"""Smallest relative decrease of the cost: the search ends when a step would lower the cost by a smaller share.

The last step is Newton's. After it, a further step could lower the cost only by about the square of this share.
"""
CAREFUL, BOLD = 1e-1, 1e-3
"""Damping at the first step: CAREFUL from the start values of the parameter set, BOLD from a start near the minimum."""
DOUBTFUL = 1e-4
"""Smallest pivot with which the Cholesky factor of a scaled inverse covariance has eight correct digits."""
LEAST_SHARE = 1e-9
"""Smallest standard deviation that is assumed for residuals, so that a spectrum without noise has a covariance."""


class Fit(NamedTuple):
    """Parameters fitted to spectra, with their covariance.

    Attributes:
        parameters: (spectrum, p), all fitted parameters.
        root: (spectrum, p, p), lower Cholesky factor of their covariance.
        cost: (spectrum,), half the sum of squared residuals.
        status: (spectrum,), how each fit ended, as values of `framework.least_squares.solution.Status`.
    """

    parameters: Float[Tensor, "spectrum p"]
    root: Float[Tensor, "spectrum p p"]
    cost: Float[Tensor, "spectrum"]
    status: Int[Tensor, "spectrum"]


def fit(
    measured: Float[Tensor, "spectrum offset"],
    offsets: Float[Tensor, "offset"],
    parameter_set: Parameters,
    start: Float[Tensor, "spectrum p"] | None = None,
    most: int = 300,
) -> Fit:
    """Fit each spectrum by least squares, from `start` or from the start values of the parameter set.

    The covariance of the parameters is (JᵀJ / s² + diag 12 / (u - l)²)⁻¹. J is the Jacobian, s² the variance of the
    residuals, l and u are the bounds of the parameters, and (u - l)² / 12 is the variance of a uniform density between
    the bounds. If the data determine a parameter, the second term is negligible. If they do not (a pool without
    amplitude has no width), the first term is negligible, and the parameter may be anywhere between its bounds.

    If the amplitude of a pool has become 0, the residuals do not depend on the pool's width, and the search cannot
    recover the pool. Such spectra are fitted once more from another start, and the better fit is kept. The same is done
    for all spectra if centres are free and no start is given, because there are two solutions: the line of amide can
    be the sharp or the broad one of two lines (benchmarks/spectra/cest.md counts how often that matters).

    Args:
        measured: measured Z; NaN where nothing was measured.
        offsets: ppm.
        parameter_set: the parameters to fit.
        start: start values; the last columns, which belong to parameters that are not the target, may be left out.
        most: largest number of steps tried.
    """
    device = measured.device
    measured = measured.detach().cpu().double().clamp(-CUT, CUT)
    offsets = offsets.to(measured)
    lower, upper, first, second = (
        measured.new_tensor(side)
        for side in (
            parameter_set.lower,
            parameter_set.upper,
            parameter_set.start,
            parameter_set.second_start,
        )
    )
    begin, damping = first.expand(len(measured), -1), CAREFUL
    if start is not None:
        given_start = start.detach().to(begin)
        given_start = given_start.where(given_start.isfinite(), begin[:, : given_start.shape[1]])
        begin, damping = torch.cat((given_start, begin[:, given_start.shape[1] :]), 1), BOLD

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

    solution = search(measured, begin, damping)
    parameters, cost, status = solution.parameters, solution.cost, solution.status
    again = status == Status.ILL_POSED
    if start is None and parameter_set.target_count > 2 * COUNT:
        again = status != Status.NOT_FINITE
    if len(lost := again.nonzero().squeeze(1)):
        again = search(measured[lost], second.expand(len(lost), -1), CAREFUL)
        better = again.cost < cost[lost]
        improved = lost[better]
        parameters[improved], cost[improved] = again.parameters[better], again.cost[better]
        status[improved] = again.status[better]
    root = _root(Misfit(measured, offsets), parameters, upper - lower)
    return Fit(*(part.to(device) for part in (parameters, root, cost, status)))


def _root(misfit: Misfit, parameters: Tensor, sides: Tensor) -> Tensor:
    """Return the lower Cholesky factor of the covariance of the parameters, (spectrum, p, p).

    `sides` are the distances between lower and upper bounds. The factor is computed for parameters divided by `sides`,
    because these have similar magnitudes.
    """
    size = parameters.shape[1]
    rows = torch.arange(len(parameters))
    cost, _, gram, measured_counts = misfit.normal(parameters, rows)
    variance = (2 * cost / (measured_counts - size).clamp(min=1)).clamp(min=LEAST_SHARE**2)
    # The inverse covariance is A = Uᵀ U with a lower triangle U, so that U⁻¹ is the lower factor of A⁻¹.
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
    """Return the same factor as `_root`, computed from the Jacobian J for spectra whose JᵀJ has lost too many digits.

    `rows` are the rows of `misfit.measured`, and `variance` is the variance of their residuals.
    """
    size = parameters.shape[1]
    residuals, jacobian = misfit(parameters, rows)
    jacobian = jacobian.where(~residuals.isnan().unsqueeze(-1), 0.0) * sides
    # Triangle R with RᵀR = JᵀJ + 12 s². The covariance is s² R⁻¹ R⁻ᵀ; its factor follows from a second QR.
    identity = torch.eye(size, dtype=parameters.dtype)
    prior = (12 * variance).sqrt()[:, None, None] * identity
    triangle = torch.linalg.qr(torch.cat((jacobian, prior), 1), mode="r").R
    inverse = torch.linalg.solve_triangular(triangle, identity.expand_as(triangle), upper=True)
    lower = torch.linalg.qr(inverse.mT, mode="r").R.mT * variance.sqrt()[:, None, None]
    return lower * lower.diagonal(dim1=-2, dim2=-1).sign().unsqueeze(-2)


def density(
    fitted: Fit, target_count: int, shape: torch.Size | tuple[int, ...], zero: Tensor
) -> Distribution:
    """Return the Gaussian density of the first `target_count` parameters in `fitted`, with batch_shape `shape`.

    `zero` (*shape, 1) is added to the mean. It holds zeros that have the dtype, the device and the gradient of the
    input of the density head that calls this function. The factor of the marginal covariance consists of the first rows
    and columns of the lower Cholesky factor.
    """
    mean = fitted.parameters[:, :target_count].reshape(*shape, target_count).to(zero) + zero
    return JointNormal(
        mean,
        fitted.root[:, :target_count, :target_count].reshape(*shape, target_count, target_count).to(zero),
    )
