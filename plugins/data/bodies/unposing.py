"""Takes a registered mesh back to the rest pose: inverse linear blend skinning (thesis §7.4.3).

The thesis makes a template of every subject, W⁻¹(X) - B_P(θ). Here that template is the model's plus offsets, so that
another pose and another shape are the model's own with the same offsets.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from plugins.data.bodies.body import BodyModel

SMALLEST = 0.2
"""Singular value of a blended matrix from which on it is inverted: errors in a mesh grow fivefold at most. A vertex
that follows two bones half and half has cos(φ / 2), φ the angle between them: 0.2 at 157°, 0 where one is turned over.
"""


class Unposed(NamedTuple):
    """What a subject has beyond the model.

    Attributes:
        offsets: in the rest pose, metres.
        folded: vertices whose blended matrix has a singular value below SMALLEST.
    """

    offsets: Float[Tensor, "batch vertex 3"]
    folded: Bool[Tensor, "batch vertex"]


@torch.no_grad()
def unposed(
    model: BodyModel,
    vertices: Float[Tensor, "batch vertex 3"],
    shape: Float[Tensor, "batch shape"],
    pose: Float[Tensor, "batch joint 3"],
    translation: Float[Tensor, "batch 3"],
) -> Unposed:
    """Offsets with which the model, in this pose, has these vertices (metres).

    With A = Σ_j w_j R_j they are A⁻¹ r, where r is what the vertices are off the bare model's in this pose: skinning is
    affine, and B_P(θ) is in both. Only r is divided, so errors of A do not count by the distance from the origin.

    Where A = U diag(σ) Vᵀ has a σ below SMALLEST the mesh hardly says what lies along that v: many places in the rest
    pose meet there. 1/σ fades to σ/SMALLEST², so that the vertex goes to the model's own place along it, of which
    posing in the same pose shows nothing; it does not jump, and no number grows without bound.

    Raises:
        ValueError: other shapes, or numbers that are not finite.
    """
    apart = vertices - model(shape, pose, translation)
    if not apart.isfinite().all():
        raise ValueError("vertices are not all finite; wanted metres of every vertex.")
    left, values, right = torch.linalg.svd(model.skinning(shape, pose).double())
    inverse = torch.where(values < SMALLEST, values / SMALLEST**2, 1 / values.clamp(min=SMALLEST))
    along = inverse * (left.mT @ apart.double()[..., None])[..., 0]
    offsets = (right.mT @ along[..., None])[..., 0].to(vertices.dtype)
    return Unposed(offsets, values[..., -1] < SMALLEST)
