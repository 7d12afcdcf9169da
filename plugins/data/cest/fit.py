"""Fits Lorentzian lines to many Z-spectra at once, and says how sure of each parameter it is."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.heads.least_squares import least_squares
from framework.heads.least_squares_solution import Solution, Status
from plugins.data.cest.spectrum import Misfit, Parameters

CUT = 10.0
"""Beyond this a measured number is no Z, which lies between 0 and about 1, and is cut off."""
DECREASE = 1e-10
"""Newton's last step leaves the square of the share of the cost that it gains."""
CAREFUL, BOLD = 1e-1, 1e-3
"""Damping at the first step from the preset's start, and from one that is near."""
LEAST_SHARE = 1e-9
"""The least standard error, in sides of the box: of a spectrum without noise."""


class Fit(NamedTuple):
    """Attributes:
    parameters: (spectrum, p), all that were fitted.
    root: (spectrum, p, p), lower Cholesky factor of their covariance.
    cost: (spectrum,), half the sum of squared residuals.
    status: (spectrum,), of framework.heads.least_squares.Status.
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
    from another start, and the better fit is kept.

    Args:
        measured: NaN where nothing was measured.
        start: (spectrum, p), or without the parameters that are no target.
        most: steps tried.
    """
    measured = measured.detach().double().clamp(-CUT, CUT)
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
            curvature=misfit.curvature,
            most=most,
            decrease=DECREASE,
            damping=damping,
        )

    found = search(measured, begin, damping)
    parameters, cost, status = found.parameters, found.cost, found.status
    if len(lost := (status == Status.ILL_POSED).nonzero().squeeze(1)):
        again = search(measured[lost], second.expand(len(lost), -1), CAREFUL)
        better = again.cost < cost[lost]
        kept = lost[better]
        parameters[kept], cost[kept] = again.parameters[better], again.cost[better]
        status[kept] = again.status[better]
    return Fit(parameters, _root(Misfit(measured, offsets), parameters, upper - lower), cost, status)


def _root(misfit: Misfit, parameters: Tensor, sides: Tensor, together: int = 512) -> Tensor:
    """The covariance's Cholesky factor; of sides of the box, in which numbers are of one size."""
    count, size = parameters.shape
    root = parameters.new_empty(count, size, size)
    for begin in range(0, count, together):
        rows = torch.arange(begin, min(begin + together, count), device=parameters.device)
        residuals, jacobian = misfit(parameters[rows], rows)
        present = ~residuals.isnan()
        residuals = residuals.where(present, 0.0)
        jacobian = jacobian.where(present.unsqueeze(-1), 0.0) * sides
        variance = residuals.square().sum(-1) / (present.sum(-1) - size).clamp(min=1)
        variance = variance.clamp(min=LEAST_SHARE**2)[:, None, None]
        # triangle R with RᵀR = JᵀJ + 12 s²; the covariance is s² R⁻¹ R⁻ᵀ, whose factor follows from another triangle
        prior = (12 * variance).sqrt() * torch.eye(size, dtype=root.dtype, device=root.device)
        triangle = torch.linalg.qr(torch.cat((jacobian, prior), 1), mode="r").R
        inverse = torch.linalg.solve_triangular(
            triangle, torch.eye(size, dtype=root.dtype, device=root.device).expand_as(triangle), upper=True
        )
        lower = torch.linalg.qr(inverse.mT, mode="r").R.mT * variance.sqrt()
        lower = lower * lower.diagonal(dim1=-2, dim2=-1).sign().unsqueeze(-2)
        root[rows] = sides.unsqueeze(-1) * lower
    return root
