"""The rotation Laplace density p(R) = exp(-d) / (d F(A)) with d² = tr(S - AᵀR) + δ² (Yin et al. 2023, Def. 3).

A = U S Vᵀ is the proper singular value decomposition, and F(A) is the normaliser. q is the quaternion of UᵀRV, called
aligned because it is 1 at the mode. For S = diag(σ₁, σ₂, σ₃), let λ₁ = 2(σ₂+σ₃), λ₂ = 2(σ₁+σ₃) and λ₃ = 2(σ₁+σ₂); they
are called `falls`, as in `framework.geometry.aligned_rotations`. Then tr(S - AᵀR) = u = Σ λᵢqᵢ². The density of the
paper has δ = 0 and is infinite at the mode. With δ = SOFTENING, the density is finite, and differs from the paper's
density only for u of the order of δ².

**The normaliser.** For d > 0 (Gradshteyn & Ryzhik 2007, 3.471.15)

    exp(-d) / d = ∫₀^∞ exp(-s d² - 1/(4s)) / √(πs) ds,

so that a rotation Laplace density is a mixture over s of the densities exp(-s Σ λᵢqᵢ²) / k(sλ). Their normaliser k is a
single integral. With s = exp(τ), the integrand is analytic around the real line, and the error of the trapezium rule in
τ falls exponentially with 1/h for the step h (Trefethen & Weideman 2014, Thm. 5.1). The tests find errors of log F
below 1e-8. A draw chooses a node s by its weight, and then a quaternion q from the density with sλ in place of λ.
"""

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd import Function

from framework.geometry import quaternions
from framework.geometry.aligned_rotations import Frame, align, legendre

SOFTENING = 1e-3
"""δ, the distance below which the density is flat, in units of d."""
STEP = 0.4
"""Step h of the trapezium rule in log s."""
NODES = 20
"""Number of nodes of each of the two panels of the quadrature for k."""
PANEL, REACH = 3.0, 44.0
"""Length of the last panel in the variable of integration y, and exponent beyond which terms are neglected."""
CHUNK = 2**21
"""Largest number of Bessel functions of one kind that are evaluated at once."""
LOW, HIGH = -5.2, math.log(45 / SOFTENING**2)
"""Range of log s; beyond it the integrand is below exp(-45) of its largest value."""


def squared_distance(
    turn: Float[Tensor, "... 4"], parameter: Float[Tensor, "... 3 3"]
) -> Float[Tensor, "..."]:
    """Return d² = tr(S - AᵀR) + δ² for unit quaternions of R and parameters A, float64; batch shapes broadcast.

    A = U S Vᵀ is the proper singular value decomposition, and δ is SOFTENING. The trace is computed as Σ λᵢqᵢ², so that
    no digits cancel (λ and q are explained in the module's docstring). d² is differentiable once; the derivative in
    `turn` is only valid for changes that keep the quaternion of unit length.

    Args:
        turn: unit quaternions of R.
        parameter: A.
    """
    return _Trace.apply(turn.double(), parameter.double()) + SOFTENING**2


def log_normaliser(parameter: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Return the logarithm of the normaliser F(A) of the density exp(-d)/d, nats; it is differentiable once.

    The density is with respect to the rotation-invariant measure of total mass 1.
    """
    return _LogNormaliser.apply(parameter.double())


@torch.no_grad()
def log_node_weights(falls: Float[Tensor, "*batch 3"]) -> tuple[Tensor, Tensor]:
    """Return the nodes s of the quadrature for the normaliser F, and the logarithms of their terms.

    F is an integral over s > 0 that depends on the parameter of the density only through λ. The sum of the terms is F.

    Args:
        falls: λ₁ ≤ λ₂ ≤ λ₃, the coefficients in d² = Σ λᵢqᵢ² + δ² for the aligned quaternion q of a rotation.

    Returns:
        s, (node,), and the logarithm of the term of each node, (*batch, node).
    """
    scale, log_part = _scales(falls)
    log_mean, _ = _log_mean(falls.unsqueeze(-2) * scale.unsqueeze(-1), moments=False)
    return scale, log_part + log_mean


def _scales(falls: Tensor) -> tuple[Tensor, Tensor]:
    """Return the nodes s of the quadrature for the normaliser F, and the logarithm of each term's factor without λ.

    A term of the quadrature (see the module) is this factor times k(sλ). `falls` only gives the device.
    """
    log_scale = torch.arange(LOW, HIGH, STEP, dtype=torch.float64, device=falls.device)
    scale = log_scale.exp()
    return scale, log_scale / 2 - 1 / (4 * scale) - scale * SOFTENING**2 + math.log(STEP / math.pi**0.5)


def _log_mean(falls: Tensor, moments: bool) -> tuple[Tensor, Tensor]:
    """Return log k(λ), and with `moments` the second moments E qᵢ², (*batch, 3).

    k is the normaliser of the density exp(-Σ λᵢqᵢ²) / k(λ) of a unit quaternion q. The integral is that of
    `framework.geometry.aligned_rotations`, with fewer nodes and with the variable of integration y:

        k(λ) = ∫₀¹ exp(-λ₂w) I₀ₑ((λ₃-λ₂)w/2) I₀ₑ(λ₁(1-w)/2) dw,   √w proportional to sinh y.
    """
    first, second, third = (falls[..., index, None] for index in range(3))
    end = REACH / second.clamp(min=REACH)
    stretch = (third - second) / 2
    start = (1 + stretch * end).rsqrt()
    length = torch.asinh(1 / start)
    border = (length - PANEL).clamp(min=0)
    node, weight = legendre(NODES, falls.device)
    y = torch.cat([border * node, border + (length - border) * node], -1)
    weight = torch.cat([border * weight, (length - border) * weight], -1)
    root = start * torch.sinh(y)
    w = end * root * root
    slope = 2 * end * root * start * torch.cosh(y)
    inner, outer = stretch * w, first / 2 * (1 - w)
    bessels = torch.special.i0e(inner), torch.special.i0e(outer)
    mass = weight * slope * torch.exp(-second * w) * bessels[0] * bessels[1]
    total = mass.sum(-1)
    if not moments:
        return total.log(), total[..., None]
    share = mass / total.unsqueeze(-1)
    # the angle 2φ of each pair of components is von Mises: E sin²φ = (1 - I₁/I₀)/2
    third_part = (1 - torch.special.i1e(inner) / bessels[0]) / 2
    first_part = (1 - torch.special.i1e(outer) / bessels[1]) / 2
    parts = [(1 - w) * first_part, w * (1 - third_part), w * third_part]
    return total.log(), torch.stack([(share * part).sum(-1) for part in parts], -1)


class _Trace(Function):
    """Autograd function of tr(S - AᵀR) for A = U S Vᵀ; its derivative with respect to A is U Vᵀ - R."""

    @staticmethod
    def forward(ctx: Any, turn: Tensor, parameter: Tensor) -> Tensor:
        frame = align(parameter)
        aligned = frame.aligned(turn)
        ctx.shapes = turn.shape, parameter.shape
        ctx.save_for_backward(aligned, *frame)
        return (frame.falls * aligned[..., 1:].square()).sum(-1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor]:
        aligned, *parts = ctx.saved_tensors
        frame = Frame(*parts)
        pull = torch.cat([torch.zeros_like(aligned[..., :1]), 2 * frame.falls * aligned[..., 1:]], -1)
        by_turn = grad.unsqueeze(-1) * frame.turn(pull)
        between = frame.left @ quaternions.matrix_less_identity(aligned) @ frame.right.mT
        by_parameter = -grad[..., None, None] * between
        return by_turn.sum_to_size(ctx.shapes[0]), by_parameter.sum_to_size(ctx.shapes[1])


class _LogNormaliser(Function):
    """Autograd function of log F(A).

    Its derivative with respect to λᵢ is minus the weighted mean of s E qᵢ² over the nodes s. Its derivative with
    respect to A = U S Vᵀ is U diag(g) Vᵀ, where g are the derivatives with respect to the singular values. The module's
    docstring explains s, λ and q.
    """

    @staticmethod
    def forward(ctx: Any, parameter: Tensor) -> Tensor:
        frame = align(parameter)
        scale, log_part = _scales(parameter)
        results, slopes = [], []
        for part in frame.falls.reshape(-1, 3).split(CHUNK // (2 * NODES * len(scale))):
            log_mean, moments = _log_mean(part.unsqueeze(-2) * scale.unsqueeze(-1), ctx.needs_input_grad[0])
            log_mass = log_part + log_mean
            results.append(log_mass.logsumexp(-1))
            share = log_mass.softmax(-1) * scale
            slopes.append(-(share.unsqueeze(-1) * moments).sum(-2))
        if ctx.needs_input_grad[0]:
            first, second, third = torch.cat(slopes).reshape(frame.falls.shape).unbind(-1)
            # λ = 2(s₂+s₃), 2(s₁+s₃), 2(s₁+s₂)
            slope = 2 * torch.stack([second + third, first + third, first + second], -1)
            ctx.save_for_backward(frame.left @ torch.diag_embed(slope) @ frame.right.mT)
        return torch.cat(results).reshape(frame.falls.shape[:-1])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (slope,) = ctx.saved_tensors
        return grad[..., None, None] * slope
