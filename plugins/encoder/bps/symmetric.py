"""Frames of symmetric clouds, whose second and third moments determine no frame: the best of a few candidates.

The third moments of a cloud that the reflection x → -x does not change are 0 and determine no direction of an axis. The
second moments of a cube are equal and determine no axes. The candidates are then the remaining directions of the axes,
or frames through points of the cloud. The candidate F with the largest value L(F a) is chosen, where a is a constant
vector and L(s) = mean exp(s·p) is the Laplace transform of the cloud's points p, which depends on moments of every
order. Apart from coincidences, two candidates have the same value only if a symmetry of the cloud maps one to the
other; the cloud then has the same coordinates in both. A rotation of the cloud rotates the chosen frame with it.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

EQUAL = 1e-6
"""Difference of second moments, as a share of the largest one, below which they count as equal.

It allows for the rounding of float32.
"""
TIE = 1e-6
"""Relative difference of lengths, and absolute difference of values of log L, below which they count as equal."""
GENERIC = (1.3, 0.9, 0.5)
"""The constant vector a of the values L(F a) that are compared; its components differ, and none is 0.

Its unit is the inverse of the root mean square of a coordinate.
"""
PAIRS_IN_MEMORY = 2**22
"""Largest number of pairs of a candidate and a point that are in memory at once."""
FLIPS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
"""Signs by which the three axes of a right-handed frame can be multiplied so that the frame stays right-handed."""


@torch.no_grad()
def symmetric_frame(
    points: Float[Tensor, "points 3"],
    axes: Float[Tensor, "3 3"],
    fixed: Bool[Tensor, "3"],
    equal: Bool[Tensor, "2"],
) -> Float[Tensor, "3 3"]:
    """Return a right-handed frame, as columns, that rotates with the cloud.

    Args:
        points: coordinates relative to the origin.
        axes: principal axes as columns, the longest first, right-handed.
        fixed: whether the third moments determine the direction of each axis; only used if no two second moments are
            equal.
        equal: whether the second moments of the first two axes are equal, and those of the last two.
    """
    if bool(equal.all()):
        frames = _frames_through_points(points)
    elif bool(equal.any()):
        last = bool(equal[0])
        axis = axes[:, 2 if last else 0]
        frames = torch.cat([_frames_about(points, direction, last=last) for direction in (axis, -axis)])
    else:
        flips = torch.tensor(FLIPS, dtype=axes.dtype, device=axes.device)
        flips = flips[(flips[:, fixed] == 1).all(1)]
        frames = axes * flips[:, None]
    generic = torch.tensor(GENERIC, dtype=frames.dtype, device=frames.device)
    return frames[_log_transform(points, frames @ generic).argmax()]


def _frames_through_points(points: Float[Tensor, "points 3"]) -> Float[Tensor, "frame 3 3"]:
    """Return candidate frames whose axes point to points of the cloud, (frame, 3, 3).

    The first axis points to one of the points farthest from the origin; if several points are equally far, only those
    with the largest Laplace transform in their direction are used. For each first axis there is one frame for each
    candidate of the second axis, as `_frames_about` describes.
    """
    first = points[_farthest(points.norm(dim=1))]
    first = first / first.norm(dim=1, keepdim=True)
    value = _log_transform(points, GENERIC[0] * first)
    return torch.cat([_frames_about(points, axis) for axis in first[value >= value.max() - TIE]])


def _frames_about(
    points: Float[Tensor, "points 3"], axis: Float[Tensor, "3"], last: bool = False
) -> Float[Tensor, "frame 3 3"]:
    """Return right-handed frames that contain `axis`, one frame for each candidate of a second axis.

    `axis` is the first column, and the candidate is the second column; if `last` is true, `axis` is the last column,
    and the candidate is the first column. Candidates are the directions, perpendicular to `axis`, towards the points
    farthest from the line along `axis`. If several points are equally far from this line, only those farthest from the
    origin along the line, on either side, give candidates.
    """
    along = points @ axis
    across = points - along[:, None] * axis
    distance = across.norm(dim=1)
    far = _farthest(distance)
    far = far[along[far].abs() >= along[far].abs().max() - TIE * distance.max()]
    towards = across[far] / distance[far, None]
    axis = axis.expand_as(towards)
    third = torch.linalg.cross(axis, towards)
    return torch.stack([towards, third, axis] if last else [axis, towards, third], -1)


def _farthest(length: Float[Tensor, "points"]) -> Tensor:
    """Return the indices of the lengths that are equal to the largest one up to TIE."""
    return (length >= (1 - TIE) * length.max()).nonzero()[:, 0]


def _log_transform(
    points: Float[Tensor, "points 3"], arguments: Float[Tensor, "argument 3"]
) -> Float[Tensor, "argument"]:
    """Return the logarithm of the Laplace transform L of the points at each row of `arguments`.

    The points are first divided by the root mean square of a coordinate. The returned numbers exceed log L by the
    constant log(number of points), which changes no comparison.
    """
    unit = points / points.square().mean().sqrt().clamp(min=torch.finfo(points.dtype).tiny)
    parts = arguments.split(max(1, PAIRS_IN_MEMORY // max(1, len(unit))))
    return torch.cat([torch.logsumexp(part @ unit.T, 1) for part in parts])
