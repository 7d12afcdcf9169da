"""Functions of Student's t that stay exact when its degrees of freedom grow without bound."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

SERIES = 25.0
"""Argument above which `log_gamma_step` and `digamma_step` use asymptotic series, which are exact to 1e-15 there."""
FAR = 1e4
"""Ratio |z|/√ν above which log(1 + z²/ν) is computed without its square, which may overflow."""


def log_gamma_step(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return log Γ(x + ½) - log Γ(x) - ½ log x for x > 0, float64; it goes to 0 as x grows.

    For large x it is the logarithm of the series of Tricomi & Erdélyi 1951, eq. 1.
    """
    x = x.double()
    small, inverse = x.clamp(max=SERIES), x.clamp(min=SERIES).reciprocal()
    direct = torch.lgamma(small + 0.5) - torch.lgamma(small) - small.log() / 2
    square = inverse.square()
    tail = square * (1 / 192 - square * (1 / 640 - square * (17 / 14336 - square * (31 / 18432))))
    return torch.where(x < SERIES, direct, inverse * (tail - 1 / 8))


def digamma_step(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return ψ(x + ½) - ψ(x) for x > 0, float64: the derivative of `log_gamma_step` plus 1/(2x)."""
    x = x.double()
    small, inverse = x.clamp(max=SERIES), x.clamp(min=SERIES).reciprocal()
    square = inverse.square()
    tail = square * (1 / 64 - square * (1 / 128 - square * (17 / 2048 - square * (31 / 2048))))
    series = inverse / 2 + square * (1 / 8 - tail)
    return torch.where(x < SERIES, torch.digamma(small + 0.5) - torch.digamma(small), series)


def log_of_square_plus_one(u: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return log(1 + u²) for any u; the square of a large u does not overflow."""
    size = u.abs()
    near, far = size.clamp(max=FAR), size.clamp(min=FAR)
    return torch.where(size < FAR, torch.log1p(near.square()), 2 * far.log() + far.reciprocal().square())


def tail_of_whole(standard: Float[Tensor, "*shape"], freedom: int) -> Float[Tensor, "*shape"]:
    """Return P(X > |z|) for X of Student's t with whole degrees of freedom ν ≥ 2, with an absolute error of 1e-15.

    z is `standard`, and ν is `freedom`. With θ = atan(|z|/√ν), P(|X| ≤ |z|) is a polynomial in cos θ, times sin θ, plus
    2θ/π for odd ν (Abramowitz & Stegun 1964, 26.7.3-4).
    """
    angle = torch.atan(standard.abs() / math.sqrt(freedom))
    sine, cosine = torch.sin(angle), torch.cos(angle)
    square = cosine.square()
    total = torch.zeros_like(angle)
    # Horner's rule: the factor from cos^k to cos^(k+2) is (k+1)/(k+2)
    for power in range(freedom - 2, 1, -2):
        total = (1 + total) * square * ((power - 1) / power)
    if freedom % 2:
        inside = 2 / math.pi * (angle + sine * cosine * (1 + total))
    else:
        inside = sine * (1 + total)
    return (1 - inside) / 2
