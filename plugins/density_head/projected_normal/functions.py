"""The projected normal density of an angle: the direction of X ~ N(μ, P⁻¹) in the plane (Mardia & Jupp 2000, §3.5.6).

Let u = (cos θ, sin θ), A = uᵀPu, D = uᵀPμ/√A and K = |P| (u₁μ₂ - u₂μ₁)²/A, so that μᵀPμ = D² + K. The integral of the
normal density along the ray of u (Wang & Gelfand 2013, eq. 3, in other symbols) is

    p(θ) = |P|^½ / (2π A) · exp(-K/2) · g(D),   g(D) = exp(-D²/2) + √(2π) D Φ(D).

Only the direction of X counts, so that |P| = 1 can be required: P = LLᵀ with L = [[exp(s), 0], [t, exp(-s)]].
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

FAR = -30.0
"""D below which an asymptotic series of g replaces a difference of nearly equal numbers."""
TERMS = (1.0, -3.0, 15.0, -105.0, 945.0, -10395.0, 135135.0)
"""Coefficients of D⁻², D⁻⁴, … in the asymptotic series of g(D) exp(D²/2); the next term is below 1e-14 at FAR."""


def log_prob(
    angle: Float[Tensor, "..."], mean: Float[Tensor, "... 2"], factor: Float[Tensor, "... 2"]
) -> Float[Tensor, "..."]:
    """Return the log-density of angles, nats, in the dtype of the parameters; shapes broadcast.

    Args:
        angle: θ, radians.
        mean: μ, the mean of the normal vector.
        factor: s and t of the Cholesky factor [[exp(s), 0], [t, exp(-s)]] of P.
    """
    cosine, sine = torch.cos(angle), torch.sin(angle)
    grow, shear = factor.unbind(-1)
    first, second = mean.unbind(-1)
    # Lᵀu and Lᵀμ, whose scalar products are A, uᵀPμ and μᵀPμ
    wide, narrow = torch.exp(grow), torch.exp(-grow)
    u_first, u_second = wide * cosine + shear * sine, narrow * sine
    m_first, m_second = wide * first + shear * second, narrow * second
    length = u_first.square() + u_second.square()
    along = (u_first * m_first + u_second * m_second) / length.sqrt()
    across = (cosine * second - sine * first).square() / length
    return -across / 2 + log_g(along) - length.log() - math.log(2 * math.pi)


def log_g(value: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return log g(D) with g(D) = exp(-D²/2) + √(2π) D Φ(D), accurate and differentiable for all D."""
    high = value.clamp(min=0)
    ahead = torch.log(
        torch.exp(-high.square() / 2) + math.sqrt(2 * math.pi) * high * torch.special.ndtr(high)
    )
    low = value.clamp(FAR, 0)
    near = torch.log1p(math.sqrt(math.pi / 2) * low * torch.special.erfcx(-low / math.sqrt(2)))
    far = value.clamp(max=FAR)
    inverse = far.square().reciprocal()
    total = torch.zeros_like(inverse)
    for term in reversed(TERMS):
        total = (total + term) * inverse
    behind = torch.where(value < FAR, torch.log(total), near)
    return torch.where(value >= 0, ahead, behind - value.clamp(max=0).square() / 2)
