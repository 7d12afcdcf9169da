"""A frame that rotates with its cloud: principal axes, whose directions are determined by third moments."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from framework.errors import ConfigError
from plugins.encoder.bps.symmetric import EQUAL, symmetric_frame

LARGEST_NORM = 1 + 1e-6
"""Largest norm of a point that influences the axes, with room for rounding.

Outliers of a robust normalisation have larger norms.
"""
EIGENVALUE_GAP = 1e-9
"""Difference of two eigenvalues, in units of the largest eigenvalue, below which they count as equal.

The axes of equal eigenvalues have no derivative.

An eigenvalue smaller than this share of the largest counts as 0: a cloud thinner than 3e-5 of its length is flat.
"""

SKEWED = 1e-6
"""Skewness above which a third moment determines the direction of the longest axis.

The limit for a shorter axis is larger by the ratio of the lengths of the axes, because the rounding error of
coordinates is relative to the longest axis.
"""


def frame(coordinates: Float[Tensor, "batch points 3"], reach: float = 1.0) -> Float[Tensor, "batch 3 3"]:
    """Return rotations whose columns are each cloud's axes, float64; `coordinates @ frame` is rotation-invariant.

    Axes are the eigenvectors of the second moments about the origin, the longest first. Each axis points in the
    direction in which the third moment along the axis is positive. The axis with the least skewness is an exception:
    its direction is the one that makes the frame right-handed. A mirror plane makes this skewness 0, so that the frame
    of a cloud with mirror planes is determined up to the cloud's own symmetries.

    `symmetric_frame` chooses the frame in two cases: if two second moments are equal up to rounding, as for a cube; and
    if fewer than two axes have a third moment that is clearly not 0, as for a cloud that the reflection x → -x does not
    change. If two second moments are nearly equal, as for points drawn on a cylinder, a small change of the cloud can
    rotate its axes by a large angle. The frame is differentiable in the clouds to any order, except where eigenvalues
    are equal.

    Args:
        coordinates: coordinates relative to the origin; rows of NaN are padding.
        reach: norm beyond which points are outliers, which do not influence the axes.
    """
    if torch.compiler.is_exporting():
        raise ConfigError(
            "The encoder bps with rotation_invariant=true cannot be exported, because the axes of a cloud are "
            "eigenvectors, for which ONNX has no operation. For an export, train a model with "
            "encoder.bps.rotation_invariant=false."
        )
    points = coordinates.double()
    norm = torch.linalg.vector_norm(points.detach(), dim=-1, keepdim=True)
    inside = norm <= LARGEST_NORM * reach  # False for NaN
    points = points.where(inside, 0)
    # sums instead of means: a common factor changes neither the eigenvectors nor the skewness below
    second = points.mT @ points
    values, axes = torch.linalg.eigh(second.detach())
    values, axes = values.flip(-1), axes.flip(-1)
    along = points.detach() @ axes
    third = along.pow(3).mean(1)
    skewness = third / along.square().mean(1).clamp(min=torch.finfo(torch.float64).tiny).pow(1.5)
    # A flat cloud is its own mirror image. Along its normal there are only rounding errors, whose skewness may be the
    # largest.
    skewness = skewness.where(values > EIGENVALUE_GAP * values[:, :1], 0)
    direction = torch.ones_like(third).where(third >= 0, -1)
    axes = axes * direction[:, None]
    weakest = skewness.abs().argmin(-1, keepdim=True)
    handedness = torch.linalg.det(axes).sign()[:, None]
    axes = axes * torch.ones_like(direction).scatter(-1, weakest, handedness)[:, None]
    tiny = torch.finfo(torch.float64).tiny
    skewed = skewness.abs() > SKEWED * (values[:, :1] / values.clamp(min=tiny)).sqrt()
    equal = values[:, :-1] - values[:, 1:] <= EQUAL * values[:, :1]
    equal &= values[:, 1:] > EIGENVALUE_GAP * values[:, :1]
    for number in ((skewed.sum(1) < 2) | equal.any(1)).nonzero()[:, 0].tolist():
        cloud = points[number].detach()[inside[number, :, 0]]
        axes[number] = symmetric_frame(cloud, axes[number], skewed[number], equal[number])
    if not second.requires_grad:
        return axes
    return Axes.apply(second, values, axes)[1]  # type: ignore[index]


class Axes(torch.autograd.Function):
    """Autograd function that makes given eigenvalues and eigenvectors differentiable with respect to their matrix.

    The matrix is that of the second moments, `second`. The forward pass returns the eigenvalues `values` and the
    eigenvectors `axes` unchanged.

    The backward pass uses only the outputs of the forward pass, so that it can itself be differentiated. The
    derivatives of torch.linalg.eigh are not finite where two eigenvalues are equal.
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
        ctx: Any, values_gradient: Tensor, axes_gradient: Tensor
    ) -> tuple[Tensor, None, None]:
        """Return the gradient with respect to the matrix `second`, and None for the arguments `values` and `axes`."""
        values, axes = ctx.saved_tensors
        # first-order perturbation: d value_j = axis_jᵀ d(second) axis_j, and
        # d axis_j = Σ_i axis_i (axis_iᵀ d(second) axis_j) / (value_j - value_i)
        gap = values[:, None] - values[..., None]
        known = gap.abs() > EIGENVALUE_GAP * values[:, :1, None]
        coefficients = (axes.mT @ axes_gradient).where(known, 0) / gap.where(known, 1)
        return axes @ (coefficients + values_gradient.diag_embed()) @ axes.mT, None, None
