"""Functions of angles: support, wrapping, distance, mean, and the exact circular median."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import constraints


class Circular(constraints.Constraint):
    """Support of a density over angles: real numbers in the last dimension, read as radians modulo 2π.

    Args:
        ranges: None if each angle covers the whole circle. Otherwise the angles are coordinates of another space (Euler
            angles of rotations, for example), and `ranges` holds (lowest, highest) of each angle, radians, within [-π,
            π]. The density then integrates to 1 over these ranges.
    """

    event_dim = 1

    def __init__(self, ranges: tuple[tuple[float, float], ...] | None = None) -> None:
        self.ranges = ranges
        super().__init__()

    def check(self, value: Tensor) -> Tensor:
        return value.isfinite().all(-1)


circular = Circular()
"""Support of a density over angles that each cover the whole circle."""


def wrap(angle: Tensor) -> Tensor:
    """Return the equivalent angle in [-π, π), radians."""
    whole_turn = 2 * math.pi
    wrapped = torch.remainder(angle + math.pi, whole_turn) - math.pi
    # remainder may round up to a whole turn for tiny negative arguments
    return torch.where(wrapped >= math.pi, wrapped - whole_turn, wrapped)


def angular_distance(first: Tensor, second: Tensor) -> Tensor:
    """Return the absolute angular deviation in [0, π], radians (Δ_AAD of thesis eq. 3.23)."""
    return wrap(first - second).abs()


def circular_mean(angle: Tensor, dim: int = -1) -> Tensor:
    """Return the direction of the mean of the unit vectors at `angle`, in [-π, π]; the mean of 359° and 1° is 0°.

    Args:
        angle: angles, radians.
        dim: dimension over which the mean is taken.
    """
    return torch.atan2(angle.sin().mean(dim), angle.cos().mean(dim))


def circular_median(samples: Float[Tensor, "samples *batch"]) -> Float[Tensor, "*batch"]:
    """Return the sample with the least mean angular deviation from all S samples (thesis eq. 3.24), exactly.

    The sum of angular distances Δ from an angle θ to the samples φ_k, F(θ) = Σ_k Δ(θ, φ_k), is piecewise linear. The
    kinks of F are convex at the samples and concave at the angles opposite to them. So the minimum of F over the whole
    circle lies at a sample, and this sample is the exact circular median.

    The samples are sorted, in O(S log S). The samples within half a turn ahead of φ_j are then consecutive, and φ_j is
    the first of them. The sum of their distances from φ_j is computed from prefix sums of the sorted angles over two
    turns, and so is the sum of the distances of all other samples. Of several minima, the smallest angle in
    [-π, π) is returned. If a sample is not finite, the result is NaN.
    """
    count = samples.shape[0]
    if count == 0:
        raise ValueError(
            "circular_median got no sample, but requires at least one sample. Draw more samples."
        )
    # float64: prefix sums over many samples cancel in float32
    angle = wrap(samples.double()).movedim(0, -1).contiguous()
    angle, _ = angle.sort(-1)
    whole_turn = 2 * math.pi
    twice = torch.cat([angle, angle + whole_turn], -1)
    prefix = torch.nn.functional.pad(twice.cumsum(-1), (1, 0))
    start = torch.arange(count, device=angle.device).expand_as(angle)
    end = torch.searchsorted(twice, angle + math.pi, right=True).clamp(max=count + start)
    ahead = (end - start).double()
    total = prefix.gather(-1, start + count) - prefix.gather(-1, start)
    near = prefix.gather(-1, end) - prefix.gather(-1, start)
    behind = count - ahead
    cost = (near - ahead * angle) + (behind * (angle + whole_turn) - (total - near))
    best = torch.where(
        angle[..., -1:].isnan(), count - 1, cost.argmin(-1, keepdim=True)
    )  # NaN is sorted last
    return angle.gather(-1, best).squeeze(-1).to(samples.dtype)


def grid(points: int, *, dtype: torch.dtype = torch.float32, device: torch.device | None = None) -> Tensor:
    """Return `points` equally spaced angles in [-π, π).

    On these angles, the trapezium rule is spectrally exact for smooth densities.
    """
    return -math.pi + 2 * math.pi / points * torch.arange(points, dtype=dtype, device=device)
