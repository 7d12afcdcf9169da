"""Inverse linear blend skinning, which moves the vertices of a registered mesh to the rest pose (thesis §7.4.3).

The thesis computes a template of every subject, W⁻¹(X) - B_P(θ): the subject's mesh X without skinning W and without
the pose blend shapes B_P. Here this template is written as the model's template plus offsets. The model with these
offsets then gives the subject in other poses and with other shape coefficients.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from framework.bodies.body import BodyModel

SMALLEST = 0.2
"""Smallest singular value of a vertex's blended matrix (`unpose`) that is inverted as it is.

Errors in a mesh are therefore amplified by a factor of 5 at most. A vertex that follows two joints with equal weights
has the singular value cos(φ / 2), where φ is the angle between their rotations: 0.2 at 157°, 0 at 180°.
"""


class Unposed(NamedTuple):
    """Differences of a subject's vertices from the body model, in the rest pose.

    Attributes:
        offsets: displacements in the rest pose, metres.
        folded: true for each vertex whose blended matrix (`BodyModel.skinning`) has a singular value below SMALLEST.
    """

    offsets: Float[Tensor, "batch vertex 3"]
    folded: Bool[Tensor, "batch vertex"]


@torch.no_grad()
def unpose(
    model: BodyModel,
    vertices: Float[Tensor, "batch vertex 3"],
    shape: Float[Tensor, "batch shape"],
    pose: Float[Tensor, "batch joint 3"],
    translation: Float[Tensor, "batch 3"],
) -> Unposed:
    """Return the offsets with which the model, in the pose `pose`, has the vertices `vertices`, metres.

    `shape`, `pose` and `translation` are arguments of `BodyModel.forward`.

    With A = Σ_j w_j R_j (`BodyModel.skinning`) the offsets are A⁻¹ r, where r is the difference of `vertices` from the
    vertices of the model without offsets in the same pose. This is exact, because skinning is affine and the pose blend
    shapes B_P(θ) are the same with and without offsets. Only r is multiplied by A⁻¹, so that the effect of errors of A
    does not grow with the distance from the origin.

    Let A = U diag(σ) Vᵀ. If a singular value σ is below SMALLEST, the mesh hardly determines the offset along the
    corresponding column v of V, because many positions in the rest pose are mapped to nearly the same point. For such a
    σ, 1/σ is replaced by σ/SMALLEST², which goes to 0 with σ. Along v the vertex then approaches the model's own
    position, which makes almost no difference in this pose. The offsets are continuous and bounded.

    Raises:
        ValueError: an argument has a wrong shape, or a number that is not finite.
    """
    residuals = vertices - model(shape, pose, translation)
    if not residuals.isfinite().all():
        raise ValueError(
            f"{int((~residuals.isfinite()).any(-1).sum())} vertices have a coordinate that is not finite; expected "
            "finite coordinates in metres. Correct or leave out this mesh."
        )
    left, values, right = torch.linalg.svd(model.skinning(shape, pose).double())
    inverse = torch.where(values < SMALLEST, values / SMALLEST**2, 1 / values.clamp(min=SMALLEST))
    along = inverse * (left.mT @ residuals.double()[..., None])[..., 0]
    offsets = (right.mT @ along[..., None])[..., 0].to(vertices.dtype)
    return Unposed(offsets, values[..., -1] < SMALLEST)
