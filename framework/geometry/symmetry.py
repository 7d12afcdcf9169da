"""Groups of rotations that leave a solid unchanged: nearest equivalent rotations, and rotations with random noise.

A solid that its group G leaves unchanged looks the same in the rotations R and R g for all g in G, so that an image
shows only the coset R G. Rotations are unit quaternions as in `framework.geometry.quaternions`.
"""

import math
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from framework.geometry import quaternions

GROUPS = ("none", "tetrahedral", "octahedral", "icosahedral", "conical", "cylindrical")
"""Names of the groups; a batch of samples refers to a group by its position in this tuple.

"none", "tetrahedral" (of a tetrahedron), "octahedral" (of a cube) and "icosahedral" have 1, 12, 24 and 60 rotations.
"conical" holds all rotations about the solid's z axis, and "cylindrical" also the half turns about all axes across it.
"""
CONTINUOUS = ("conical", "cylindrical")
"""Groups with infinitely many rotations."""
GOLDEN = (1 + 5**0.5) / 2


@cache
def rotations_of(group: str) -> Float[Tensor, "rotation 4"]:
    """Return the rotations of a finite group, one of the two quaternions of each, float64.

    The quaternions are those of Conway & Smith 2003, §3.3 (the Hurwitz units and, for the icosahedron, the icosians).
    The axes of the cube, and three 2-fold axes of tetrahedron and icosahedron that are at right angles, are x, y, z.

    Raises:
        ValueError: the group is continuous or unknown.
    """
    units = torch.eye(4, dtype=torch.float64)
    if group == "none":
        return units[:1]
    if group not in ("tetrahedral", "octahedral", "icosahedral"):
        raise ValueError(
            f"{group!r} is no finite group of rotations. Choose none, tetrahedral, octahedral or icosahedral."
        )
    halves = torch.cartesian_prod(*[torch.tensor([0.5, -0.5], dtype=torch.float64)] * 4)
    parts = [units, halves[halves[:, 0] > 0]]
    if group == "octahedral":
        pairs = [units[i] + sign * units[j] for i in range(4) for j in range(i + 1, 4) for sign in (1, -1)]
        parts.append(torch.stack(pairs) / 2**0.5)
    if group == "icosahedral":
        even = [(0, 1, 2, 3), (0, 2, 3, 1), (0, 3, 1, 2), (1, 0, 3, 2), (1, 2, 0, 3), (1, 3, 2, 0)]
        even += [(2, 0, 1, 3), (2, 1, 3, 0), (2, 3, 0, 1), (3, 0, 2, 1), (3, 1, 0, 2), (3, 2, 1, 0)]
        signs = torch.cartesian_prod(*[torch.tensor([1.0, -1.0], dtype=torch.float64)] * 3)
        numbers = torch.tensor([GOLDEN / 2, 0.5, 1 / (2 * GOLDEN), 0.0], dtype=torch.float64)
        signed = numbers * torch.cat([signs, torch.ones_like(signs[:, :1])], -1)
        icosians = torch.cat([signed[:, list(order)] for order in even])
        first = icosians.gather(-1, (icosians != 0).double().argmax(-1, keepdim=True))
        parts.append(icosians[first[:, 0] > 0])
    return torch.cat(parts)


def nearest_distance(
    first: Float[Tensor, "... 4"], second: Float[Tensor, "... 4"], group: str
) -> Float[Tensor, "..."]:
    """Return the smallest angle between the rotation `second` and the rotations `first` g, g in the group, radians.

    Batch shapes broadcast.
    """
    relative = quaternions.product(quaternions.inverse(first), second)
    if group in CONTINUOUS:
        across = torch.hypot(relative[..., 1], relative[..., 2])
        along = torch.hypot(relative[..., 0], relative[..., 3])
        angle = 2 * torch.atan2(across, along)
        return angle if group == "conical" else torch.minimum(angle, math.pi - angle)
    members = rotations_of(group).to(relative)
    nearest = members[(relative @ members.mT).abs().argmax(-1)]
    between = quaternions.product(quaternions.inverse(nearest), relative)
    return 2 * torch.atan2(torch.linalg.vector_norm(between[..., 1:], dim=-1), between[..., 0].abs())


def noise_concentration(deviation: float) -> float:
    """Return κ of the density exp(2κ cos ω) / c of a random rotation by the angle ω about a uniformly random axis.

    This is the matrix Fisher density with F = κI. `deviation` is the standard deviation σ of the rotation about each of
    x, y and z, radians. For a small σ, exp(2κ cos ω) is near exp(2κ - κω²), so that κ = 1/(2σ²).
    """
    return 1 / (2 * deviation**2)


def log_blurred(
    first: Float[Tensor, "... 4"], second: Float[Tensor, "... 4"], group: str, concentration: float
) -> Float[Tensor, "..."]:
    """Return the log-density of the random rotation R g N at `second`; R is `first`, g uniform in the group, N noise.

    The result is in nats with respect to the rotation-invariant measure of total mass 1, float64. N has the density
    exp(2κ cos ω) / c of `noise_concentration`, with κ = `concentration` and c = I₀(2κ) - I₁(2κ), the integral over ω
    with the measure (1 - cos ω) dω/π. For a finite group, the density is the mean of the noise density over the group.
    For all rotations about z, let β be the angle between the z axes of both rotations: the mean over the group is the
    integral

        ∫ exp(2κ (cos²(β/2) (1 + cos θ) - 1)) dθ/2π / c = exp(-2κ sin²(β/2)) I₀(2κ cos²(β/2)) / c.

    For the group with half turns across z too, the density is the mean of this function at β and at π - β.
    """
    relative = quaternions.product(quaternions.inverse(first.double()), second.double())
    double = torch.tensor(2 * concentration, dtype=torch.float64)
    # c exp(-2κ)
    log_constant = torch.log(torch.special.i0e(double) - torch.special.i1e(double))
    if group not in CONTINUOUS:
        members = rotations_of(group)
        cosine = (relative @ members.mT).abs().clamp(max=1)  # of ω/2
        return torch.logsumexp(-4 * concentration * (1 - cosine.square()), -1) - (
            math.log(len(members)) + log_constant
        )
    near = relative[..., [0, 3]].square().sum(-1)  # cos²(β/2)
    far = relative[..., [1, 2]].square().sum(-1)

    def mean(near: Tensor, far: Tensor) -> Tensor:
        return torch.log(torch.special.i0e(double * near)) - 2 * double * far

    if group == "conical":
        return mean(near, far) - log_constant
    return torch.logaddexp(mean(near, far), mean(far, near)) - math.log(2) - log_constant


def draw_noise(count: int, concentration: float, generator: torch.Generator | None = None) -> Tensor:
    """Return `count` random rotations with the density of `noise_concentration`, quaternions, float64.

    The axis is uniform. With κ = `concentration`, the angle ω has the density sin²(ω/2) exp(-4κ sin²(ω/2)) up to a
    constant. The inverse of its distribution function is interpolated on a fine grid.
    """
    root = torch.linspace(0, 1, 200_001, dtype=torch.float64)
    most = min(1.0, math.sqrt(45 / (4 * concentration)))
    angle = torch.asin(root * most)  # ω/2; dω is proportional to its differential
    height = torch.exp(-4 * concentration * angle.sin().square()) * angle.sin().square()
    mass = torch.cat([torch.zeros(1).double(), ((height[1:] + height[:-1]) / 2 * angle.diff()).cumsum(0)])
    uniform = torch.rand(count, dtype=torch.float64, generator=generator) * mass[-1]
    index = torch.searchsorted(mass, uniform, right=True).clamp(1, len(mass) - 1)
    share = (uniform - mass[index - 1]) / (mass[index] - mass[index - 1])
    half = angle[index - 1] + share * (angle[index] - angle[index - 1])
    axis = torch.randn(count, 3, dtype=torch.float64, generator=generator)
    axis = axis / torch.linalg.vector_norm(axis, dim=-1, keepdim=True)
    return torch.cat([half.cos()[:, None], half.sin()[:, None] * axis], -1)


def draw_members(count: int, group: str, generator: torch.Generator | None = None) -> Tensor:
    """Return `count` rotations drawn uniformly from a group, quaternions, float64."""
    if group in CONTINUOUS:
        half = math.pi * torch.rand(count, dtype=torch.float64, generator=generator)
        zero = torch.zeros_like(half)
        members = torch.stack([half.cos(), zero, zero, half.sin()], -1)
        if group == "conical":
            return members
        across = torch.stack([zero, half.cos(), half.sin(), zero], -1)
        flip = torch.rand(count, 1, dtype=torch.float64, generator=generator) < 0.5
        return torch.where(flip, across, members)
    rotations = rotations_of(group)
    return rotations[torch.randint(len(rotations), (count,), generator=generator)]
