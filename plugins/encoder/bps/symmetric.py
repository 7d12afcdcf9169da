"""Frames of symmetric clouds, whose second and third moments determine no frame: the best of a few candidates.

A cloud that is its own image under x → -x has no third moments, so that none of its axes has a direction. A cloud with
equal second moments, such as a cube, has no axes. The candidates are then the remaining directions of the axes, or
frames through points of the cloud. The candidate with the largest L(F a) is chosen, where F is the candidate, a is a
constant, and L(s) = mean exp(s·p) is the Laplace transform of the cloud, which holds moments of every order. Two
candidates have the same value, but for coincidences, only if a symmetry of the cloud maps one to the other; the cloud
looks the same in both. No rotation of the cloud changes the choice.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

EQUAL = 1e-6
"""Relative difference, in units of the largest, below which second moments are equal to the rounding of float32."""
TIED = 1e-6
"""Difference below which lengths, relative to themselves, and values of L are equal."""
GENERIC = (1.3, 0.9, 0.5)
"""The vector a, in inverse units of the root mean square of a coordinate: its components differ, and none is 0."""
AT_ONCE = 2**22
"""Largest number of pairs of a candidate and a point that are held at once."""
FLIPS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
"""Directions of three axes that leave a frame right-handed."""


@torch.no_grad()
def symmetric_frame(
    points: Float[Tensor, "points 3"],
    axes: Float[Tensor, "3 3"],
    fixed: Bool[Tensor, "3"],
    equal: Bool[Tensor, "2"],
) -> Float[Tensor, "3 3"]:
    """Return a right-handed frame, as columns, that rotates with the cloud.

    Args:
        points: relative to the origin.
        axes: principal axes as columns, the longest first, right-handed.
        fixed: axes whose direction is determined by their third moments; read if no two second moments are equal.
        equal: whether the second moments of the first two axes are equal, and those of the last two.
    """
    if bool(equal.all()):
        frames = _through_two_points(points)
    elif bool(equal.any()):
        last = bool(equal[0])
        axis = axes[:, 2 if last else 0]
        frames = torch.cat([_about(points, one, last=last) for one in (axis, -axis)])
    else:
        flips = torch.tensor(FLIPS, dtype=axes.dtype, device=axes.device)
        flips = flips[(flips[:, fixed] == 1).all(1)]
        frames = axes * flips[:, None]
    generic = torch.tensor(GENERIC, dtype=frames.dtype, device=frames.device)
    return frames[_log_transform(points, frames @ generic).argmax()]


def _through_two_points(points: Float[Tensor, "points 3"]) -> Float[Tensor, "frame 3 3"]:
    """Return frames through points of the cloud, (frame, 3, 3).

    The first axis leads to one of the farthest points; the second leads towards one of those that are farthest from
    this axis.
    """
    first = points[_farthest(points.norm(dim=1))]
    first = first / first.norm(dim=1, keepdim=True)
    value = _log_transform(points, GENERIC[0] * first)
    return torch.cat([_about(points, axis) for axis in first[value >= value.max() - TIED]])


def _about(
    points: Float[Tensor, "points 3"], axis: Float[Tensor, "3"], last: bool = False
) -> Float[Tensor, "frame 3 3"]:
    """Return frames with `axis` as their first column, or as their last.

    Another axis leads towards one of the points that are farthest from `axis`; of these, towards one that is farthest
    along it, in either direction.
    """
    along = points @ axis
    across = points - along[:, None] * axis
    distance = across.norm(dim=1)
    far = _farthest(distance)
    far = far[along[far].abs() >= along[far].abs().max() - TIED * distance.max()]
    towards = across[far] / distance[far, None]
    axis = axis.expand_as(towards)
    third = torch.linalg.cross(axis, towards)
    return torch.stack([towards, third, axis] if last else [axis, towards, third], -1)


def _farthest(length: Float[Tensor, "points"]) -> Tensor:
    """Return the indices of the largest lengths."""
    return (length >= (1 - TIED) * length.max()).nonzero()[:, 0]


def _log_transform(
    points: Float[Tensor, "points 3"], places: Float[Tensor, "place 3"]
) -> Float[Tensor, "place"]:
    """Return log L of the points, in units of the root mean square of a coordinate."""
    unit = points / points.square().mean().sqrt().clamp(min=torch.finfo(points.dtype).tiny)
    parts = places.split(max(1, AT_ONCE // max(1, len(unit))))
    return torch.cat([torch.logsumexp(part @ unit.T, 1) for part in parts])
