"""Probability integral transform of one number, and distances of such transforms from the uniform distribution."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular, circular_mean
from framework.distributions.circular_moments import circular_moments
from framework.distributions.protocol import arc_length, arc_probability, cdf


def transform(density: Distribution, value: Float[Tensor, "batch 1"], samples: int) -> Float[Tensor, "batch"]:
    """Return F(y) under a density of one real or one angle, float64 in [0, 1]; uniform if the density is the true one.

    For an angle, F is the mass from the antipode of the density's mean direction counter-clockwise to y; where the mean
    has no direction, it is the mass from ±π. The result is exact where `cdf` or `circular_moments` are exact; otherwise
    it is the rank of y among `samples` draws, (r + ½)/(S + 1).
    """
    if isinstance(density.support, Circular):
        return _circular(density, value.double(), samples)
    known = cdf(density, value)
    if known is not None:
        return known
    drawn = density.sample(torch.Size((samples,))).double()
    return _rank((drawn - value.double()).squeeze(-1))


def _circular(density: Distribution, value: Tensor, samples: int) -> Tensor:
    seen = circular_moments(density)
    start, drawn = seen.direction - math.pi, None
    if not bool(seen.resolved.all()):
        drawn = density.sample(torch.Size((samples,))).double().squeeze(-1)
        start = torch.where(seen.resolved, start, circular_mean(drawn, 0) - math.pi)
    known = arc_probability(density, start.unsqueeze(-1), value)
    if known is not None:
        return known
    at = value.squeeze(-1)
    found = seen.arc_probability(start, at)
    if drawn is None:
        return found
    return torch.where(seen.resolved, found, _rank(arc_length(start, drawn) - arc_length(start, at)))


def _rank(ahead: Float[Tensor, "samples batch"]) -> Float[Tensor, "batch"]:
    """Return the rank of zero among the numbers as a share in (0, 1); a tie counts half. NaN where a number is NaN."""
    below = (ahead < 0).double().sum(0) + (ahead == 0).double().sum(0) / 2
    share = (below + 0.5) / (len(ahead) + 1)
    return torch.where(ahead.isnan().any(0), torch.nan, share)


def kolmogorov_smirnov(values: Float[Tensor, "count"]) -> Float[Tensor, ""]:
    """Return sup |F̂(u) - u| over [0, 1]; NaN if there are no values or one of them is NaN."""
    count = len(values)
    if count == 0:
        return values.new_tensor(torch.nan)
    ordered = values.sort().values
    step = torch.arange(count + 1, dtype=values.dtype, device=values.device) / count
    return torch.maximum((step[1:] - ordered).amax(), (ordered - step[:-1]).amax())


def cramer_von_mises(values: Float[Tensor, "count"]) -> Float[Tensor, ""]:
    """Return ∫ (F̂(u) - u)² du, the Cramér-von Mises statistic over the count; NaN without values or with a NaN."""
    count = len(values)
    if count == 0:
        return values.new_tensor(torch.nan)
    middle = (torch.arange(count, dtype=values.dtype, device=values.device) + 0.5) / count
    # 1/(12n²) + mean((u_(i) - (2i-1)/2n)²) (Anderson & Darling 1952, §5)
    return (values.sort().values - middle).square().mean() + 1 / (12 * count**2)
