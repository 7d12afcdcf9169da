"""Divergences between a density and a uniform one, for every kind of target."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular
from framework.distributions.closed_forms import normal_quantile

DRAWS = 16
"""Number of targets from which the divergence of a continuous density is estimated, for each item of the batch."""


def from_uniform(density: Distribution) -> Float[Tensor, "*batch"]:
    """Return KL(p ‖ u) = log K - H(p) of a density p over K classes, nats; u is the uniform density.

    This is the penalty of thesis eq. 2.21 plus a constant.
    """
    log_prob = density.log_prob(density.enumerate_support())
    # p log p → 0 as p → 0; log p is clamped, because 0 × ∞ would be NaN where p rounds to 0
    return (log_prob.exp() * log_prob.clamp(min=-1e4)).sum(0) + math.log(len(log_prob))


def to_uniform(density: Distribution) -> Float[Tensor, "*batch"]:
    """Return KL(u ‖ p) = -Σ_k log p_k / K - log K of a density p over K classes, nats; u is the uniform density.

    Source: Hendrycks et al. 2019, §4.
    """
    log_prob = density.log_prob(density.enumerate_support())
    return -log_prob.mean(0) - math.log(len(log_prob))


def to_ignorance(density: Distribution, scale: float) -> Float[Tensor, "*batch"]:
    """Return an unbiased estimate of KL(u ‖ p) = E_u[-log p] - H(u) of a continuous density, nats.

    The divergence is estimated from n = DRAWS targets sampled from u, which is uniform for every angle and N(0, scale²)
    for every real number. If the support of the density restricts its angles to ranges, the angles describe a rotation,
    and u is uniform over rotations: sin e is uniform for an elevation e in [-π/2, π/2].

    The n targets are a Latin hypercube (McKay, Beckman & Conover 1979): if the distribution of a number is divided into
    n parts of equal probability, each part holds one target. The estimate for one number therefore has an error of
    O(n^-3/2) instead of O(n^-1/2). All members of a density with batch_shape (batch, member) get the same targets.
    """
    support = density.support
    numbers = density.event_shape[0]
    members = (1,) * (len(density.batch_shape) - 1)
    like = density.sample(torch.Size((0,)))  # an empty sample has the density's dtype and device
    place = latin_hypercube((*density.batch_shape[:1], *members, numbers), like.device)
    if isinstance(support, Circular):
        ranges = support.ranges or ((-math.pi, math.pi),) * numbers
        low, high = torch.tensor(ranges, dtype=place.dtype, device=place.device).T
        # an elevation, whose range is half a turn, has the density cos e / 2 under random rotations
        elevation = high - low < 1.5 * math.pi
        targets = torch.where(elevation, (2 * place - 1).asin(), low + place * (high - low))
        log_each = torch.where(elevation, (targets.cos() / 2).log(), -(high - low).log())
        # at the same targets, so that the estimate is exactly 0 for equal densities
        entropy = -log_each.sum(-1).mean(0)
    else:
        targets = scale * normal_quantile(place)
        entropy = numbers * (0.5 + 0.5 * math.log(2 * math.pi) + math.log(scale))
    cross_entropy = -density.log_prob(targets.to(like.dtype)).mean(0)
    return cross_entropy - torch.as_tensor(entropy).to(cross_entropy)


def latin_hypercube(shape: tuple[int, ...], device: torch.device) -> Float[Tensor, "draw *shape"]:
    """Return DRAWS random numbers in [0, 1) for each element of `shape`, float64, in random order.

    [0, 1) is divided into DRAWS equal parts, and each part holds one of the numbers.
    """
    order = torch.rand(DRAWS, *shape, dtype=torch.float64, device=device).argsort(0)
    return (order + torch.rand(DRAWS, *shape, dtype=torch.float64, device=device)) / DRAWS
