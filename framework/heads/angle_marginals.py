"""The log-density of one angle of a viewpoint whose rotation is matrix Fisher, from F = 0 to concentrations of 1e12."""

import math
from collections.abc import Callable, Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from framework.distributions.shapes import broadcast_shapes
from framework.geometry import quaternions
from framework.geometry.aligned_rotations import Frame, log_height
from framework.heads import peak_quadrature as quadrature

CHUNK = 2**18
"""Number of points at which the density is evaluated at once; arrays of 2 MB stay in the processor's cache."""
FEW = {32: 19.0, 48: 54.0, 96: 236.0, 192: 368.0}
"""Numbers of nodes of a quadrature with fixed nodes, each with the largest λ₃ for which it suffices.

framework/geometry/aligned_rotations.py defines λ₃ and the quaternion q.

As a function of a single angle a, the log-density is c - Σ λᵢqᵢ² = c' + κ cos(a - φ) with constants c, c', φ and with κ
at most λ₃/2. For exp(κ cos) the trapezium rule with N nodes on the circle has the relative error 2 I_N(κ)/I₀(κ), which
is below 1e-15 here. For Gauss-Legendre quadrature on half of the circle the limits were found by experiment: the
log-density has an error of at most 5e-12 (`test_few_nodes_do_up_to_their_bound`). For a larger λ₃, the nodes
are placed around the peaks.
"""
MOST = 2 * quadrature.PEAKS * sum(quadrature.NODES)
"""Number of nodes of a quadrature whose nodes are placed around the peaks of its integrand."""


@torch.no_grad()
def log_marginal(angle: Float[Tensor, "..."], frame: Frame, index: int) -> Float[Tensor, "..."]:
    """Return the log-density of azimuth (index 0), elevation (1) or tilt (2), radians; nats, float64.

    `frame` describes the matrix Fisher density of the rotation (`aligned_rotations.align`). The batch shape of `frame`
    broadcasts with the shape of `angle`.

    For each of the three angles α, the aligned quaternion q is a linear function of the pair (cos α/2, sin α/2), so
    that Σ λᵢqᵢ² is a quadratic form of this pair. With the smaller and larger eigenvalues μ and ν of the form, the
    integral over one of the other two angles is a Bessel function. The integral over the last angle is computed by
    quadrature. For the azimuth a and quadrature over the elevation e this is

        p(a) = ∫ cos e / (4π k(λ)) exp(-μ) I₀ₑ((ν-μ)/2) de

    with the normaliser k(λ) of the density of the rotation and I₀ₑ(x) = I₀(x) exp(-x) (aligned_rotations).
    """
    shape = broadcast_shapes(angle.shape, frame.falls.shape[:-1])
    parts = (quaternions.of_matrix(frame.left), quaternions.of_matrix(frame.right), frame.falls)
    parts = [part.expand(*shape, part.shape[-1]).reshape(-1, part.shape[-1]) for part in parts]
    angles = angle.double().expand(shape).reshape(-1)
    bounds = torch.tensor(list(FEW.values()), dtype=torch.float64, device=angles.device)
    kind = torch.bucketize(parts[2].amax(-1), bounds)  # NaN belongs to the last kind
    log_density = torch.empty_like(angles)
    for number, count in enumerate([*FEW, None]):
        for rows in (kind == number).nonzero()[:, 0].split(CHUNK // (count or MOST)):
            if len(rows) == 0:
                continue
            left, right, falls = (part[rows] for part in parts)
            log_density[rows] = _log_integral(angles[rows], left, right, falls, index, count)
    return log_density.reshape(shape) + log_height(frame.falls)


def _log_integral(
    angle: Tensor, left: Tensor, right: Tensor, falls: Tensor, index: int, count: int | None
) -> Tensor:
    """Return the log-density of one angle, nats, without the constant -log k(λ) (`log_marginal`).

    It is the density of all three angles, integrated over the other two. `index` says which angle it is, as in
    `log_marginal`; `left`, `right` and `falls` are attributes of the argument `frame` of `log_marginal`. The integral
    over the third angle is a Bessel function. The integral over the second one
    is a quadrature with `count` fixed nodes or, if `count` is None, with nodes around the peaks.
    """
    around = index == 1  # quadrature runs over the azimuth then, otherwise over the elevation
    log_density = _log_density(angle, left, right, falls, index)
    low, high = (-math.pi, math.pi) if around else (-math.pi / 2, math.pi / 2)
    if count is None:
        points, weights = quadrature.nodes(log_density, low, high, angle, periodic=around)
    else:
        plain = quadrature.equal if around else quadrature.gauss
        points, weights = (part.to(angle.device) for part in plain(count, low, high))
    volume = torch.cos(angle[..., None] if around else points).abs() / (4 * math.pi)
    return torch.logsumexp(log_density(points) + torch.log(weights * volume), -1)


def _log_density(
    angle: Tensor, left: Tensor, right: Tensor, falls: Tensor, index: int
) -> Callable[[Tensor], Tensor]:
    """Return a function from values of the second angle, (*batch, point), to the log-density of both angles.

    The density is integrated over the third angle. `angle` holds values of the angle number `index`; the other
    arguments are those of `_log_integral`.
    """
    _, i, _, k = torch.eye(4, dtype=falls.dtype, device=falls.device)
    product = quaternions.product
    # the viewpoint's quaternion is (1, k)·(cos, sin)(t/2) (1, i)·(cos, sin)(e/2 - π/4) (1, -k)·(cos, sin)(a/2)
    if index == 0:
        turned = quaternions.about(3, -angle)
        corners = turned, product(i, turned), product(k, turned), product(product(k, i), turned)
    elif index == 1:
        turned = quaternions.about(1, angle - math.pi / 2)
        corners = turned, product(turned, -k), product(k, turned), product(product(k, turned), -k)
    else:
        turned = quaternions.about(3, angle)
        corners = turned, product(turned, i), product(turned, k), product(turned, product(i, k))
    corners = [product(product(quaternions.inverse(left), corner), right)[..., 1:] for corner in corners]
    # each component is (*batch, 1)
    even, odd, even_turned, odd_turned = (corner.unsqueeze(-1).unbind(-2) for corner in corners)
    fall = falls.unsqueeze(-1).unbind(-2)

    def log_density(points: Tensor) -> Tensor:
        half = points / 2 if index == 1 else points / 2 - math.pi / 4
        cosine, sine = torch.cos(half), torch.sin(half)
        first = [cosine * even[n] + sine * odd[n] for n in range(3)]
        second = [cosine * even_turned[n] + sine * odd_turned[n] for n in range(3)]
        scaled = [fall[n] * second[n] for n in range(3)]
        one_one = _sum(fall[n] * first[n] * first[n] for n in range(3))
        two_two = _sum(scaled[n] * second[n] for n in range(3))
        one_two = _sum(scaled[n] * first[n] for n in range(3))
        # the determinant of a Gram matrix is a sum of squares (Cauchy-Binet formula), so that nothing cancels
        determinant = _sum(
            fall[n] * fall[m] * (first[n] * second[m] - first[m] * second[n]).square()
            for n, m in ((0, 1), (0, 2), (1, 2))
        )
        spread = torch.hypot(one_one - two_two, 2 * one_two)
        larger = (one_one + two_two + spread) / 2
        smaller = determinant / larger.clamp(min=torch.finfo(larger.dtype).tiny)
        return torch.log(torch.special.i0e(spread / 2)) - smaller

    return log_density


def _sum(terms: Iterable[Tensor]) -> Tensor:
    first, second, third = terms
    return first + second + third
