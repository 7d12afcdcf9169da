"""A frame that rotates with its cloud: principal axes, with directions by third moments."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from plugins.encoder.bps.symmetric import EQUAL, symmetric_frame

WITHIN = 1 + 1e-6
"""Norm up to which a point of a normalised cloud counts, to rounding; outliers of a robust normalisation lie beyond."""
APART = 1e-9
"""Difference below which eigenvalues, in units of the largest, are equal, so that their axes have no derivative.

An eigenvalue below it is 0: a cloud thinner than 3e-5 of its length is flat.
"""

SKEWED = 1e-6
"""Skewness above which a third moment determines the direction of the longest axis.

It is larger for a shorter axis, in proportion to the ratio of the lengths, since coordinates are rounded in units of
the longest.
"""


def frame(coordinates: Float[Tensor, "batch points 3"], reach: float = 1.0) -> Float[Tensor, "batch 3 3"]:
    """Return rotations whose columns are each cloud's axes, float64; `coordinates @ frame` is rotation-invariant.

    Axes are the eigenvectors of the second moments about the origin, the longest first. An axis points to where the
    third moment along it is positive. The axis of least skewness, which a mirror plane makes 0, completes a
    right-handed frame instead, so that the frame of a cloud with mirror planes is determined up to the cloud's own
    symmetries. `symmetric_frame` chooses where two moments are equal to rounding, as of a cube, or fewer than two axes
    are skewed, as of a cloud that x → -x does not change. Where two moments are nearly equal, as of points drawn on a
    cylinder, a small change of the cloud rotates its axes far. The frame is differentiable in the clouds to any order,
    except where eigenvalues are equal.

    Args:
        coordinates: relative to the origin; rows of NaN are padding.
        reach: norm beyond which points are outliers, which do not count.
    """
    points = coordinates.double()
    norm = torch.linalg.vector_norm(points.detach(), dim=-1, keepdim=True)
    inside = norm <= WITHIN * reach  # False for NaN
    points = points.where(inside, 0)
    # sums, not means: a factor changes no eigenvector, and the skewness below does not depend on it
    second = points.mT @ points
    values, axes = torch.linalg.eigh(second.detach())
    values, axes = values.flip(-1), axes.flip(-1)
    along = points.detach() @ axes
    third = along.pow(3).mean(1)
    skewness = third / along.square().mean(1).clamp(min=torch.finfo(torch.float64).tiny).pow(1.5)
    # A flat cloud is its own mirror image. Along its normal there are only rounding errors, whose skewness may be the
    # largest.
    skewness = skewness.where(values > APART * values[:, :1], 0)
    direction = torch.ones_like(third).where(third >= 0, -1)
    axes = axes * direction[:, None]
    weakest = skewness.abs().argmin(-1, keepdim=True)
    handedness = torch.linalg.det(axes).sign()[:, None]
    axes = axes * torch.ones_like(direction).scatter(-1, weakest, handedness)[:, None]
    tiny = torch.finfo(torch.float64).tiny
    skewed = skewness.abs() > SKEWED * (values[:, :1] / values.clamp(min=tiny)).sqrt()
    equal = values[:, :-1] - values[:, 1:] <= EQUAL * values[:, :1]
    equal &= values[:, 1:] > APART * values[:, :1]
    for number in ((skewed.sum(1) < 2) | equal.any(1)).nonzero()[:, 0].tolist():
        cloud = points[number].detach()[inside[number, :, 0]]
        axes[number] = symmetric_frame(cloud, axes[number], skewed[number], equal[number])
    if not second.requires_grad:
        return axes
    return Axes.apply(second, values, axes)[1]  # type: ignore[index]


class Axes(torch.autograd.Function):
    """Known eigenvalues and eigenvectors, with derivatives in the matrix that they belong to.

    The backward uses only the outputs of the forward, so that it has derivatives in turn. Those of torch.linalg.eigh
    are not finite where two eigenvalues are equal.
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, second: Tensor, values: Tensor, axes: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the eigenvalues and eigenvectors unchanged."""
        values, axes = values.clone(), axes.clone()
        ctx.save_for_backward(values, axes)
        return values, axes

    @staticmethod
    def backward(  # type: ignore[override]
        ctx: Any, of_values: Tensor, of_axes: Tensor
    ) -> tuple[Tensor, None, None]:
        """Return the gradient in the matrix."""
        values, axes = ctx.saved_tensors
        # first-order perturbation: d value_j = axis_jᵀ d(second) axis_j, and
        # d axis_j = Σ_i axis_i (axis_iᵀ d(second) axis_j) / (value_j - value_i)
        gap = values[:, None] - values[..., None]
        known = gap.abs() > APART * values[:, :1, None]
        turn = (axes.mT @ of_axes).where(known, 0) / gap.where(known, 1)
        return axes @ (turn + of_values.diag_embed()) @ axes.mT, None, None
