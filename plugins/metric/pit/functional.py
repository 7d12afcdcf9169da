"""Probability integral transform of one number, and distances of transforms from the uniform distribution."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular, circular_mean
from framework.distributions.circular_moments import circular_moments
from framework.distributions.protocol import arc_length, arc_probability, cdf


def transform(density: Distribution, value: Float[Tensor, "batch 1"], samples: int) -> Float[Tensor, "batch"]:
    """Return F(y) under a density of one real number or one angle, float64 in [0, 1].

    F(y) is uniformly distributed if the density is the true one. For an angle, F is the mass from the antipode of the
    density's mean direction counter-clockwise to y, or from ±π if the mean has no direction. The result is exact if
    `cdf` or `circular_moments` is exact. Otherwise it is (r + ½)/(S + 1), where r is the rank of y among S = `samples`
    draws.
    """
    if isinstance(density.support, Circular):
        return _circular(density, value.double(), samples)
    known = cdf(density, value)
    if known is not None:
        return known
    draws = density.sample(torch.Size((samples,))).double()
    return _rank((draws - value.double()).squeeze(-1))


def _circular(density: Distribution, value: Tensor, samples: int) -> Tensor:
    moments = circular_moments(density)
    start, draws = moments.direction - math.pi, None
    if not bool(moments.resolved.all()):
        draws = density.sample(torch.Size((samples,))).double().squeeze(-1)
        start = torch.where(moments.resolved, start, circular_mean(draws, 0) - math.pi)
    known = arc_probability(density, start.unsqueeze(-1), value)
    if known is not None:
        return known
    at = value.squeeze(-1)
    exact = moments.arc_probability(start, at)
    if draws is None:
        return exact
    return torch.where(moments.resolved, exact, _rank(arc_length(start, draws) - arc_length(start, at)))


def _rank(ahead: Float[Tensor, "samples batch"]) -> Float[Tensor, "batch"]:
    """Return the rank of 0 among the numbers in `ahead` as a share in (0, 1); NaN if a number is NaN.

    `ahead` holds the difference of each sample from the target. A sample that equals the target counts half.
    """
    below = (ahead < 0).double().sum(0) + (ahead == 0).double().sum(0) / 2
    share = (below + 0.5) / (len(ahead) + 1)
    return torch.where(ahead.isnan().any(0), torch.nan, share)


def kolmogorov_smirnov(values: Float[Tensor, "count"]) -> Float[Tensor, ""]:
    """Return sup |F̂(u) - u| over u in [0, 1]; NaN without values or if a value is NaN.

    F̂ is the empirical distribution function of `values`.
    """
    count = len(values)
    if count == 0:
        return values.new_tensor(torch.nan)
    ordered = values.sort().values
    step = torch.arange(count + 1, dtype=values.dtype, device=values.device) / count
    return torch.maximum((step[1:] - ordered).amax(), (ordered - step[:-1]).amax())


def cramer_von_mises(values: Float[Tensor, "count"]) -> Float[Tensor, ""]:
    """Return ∫ (F̂(u) - u)² du over [0, 1], the Cramér-von Mises statistic divided by the number of values.

    F̂ is the empirical distribution function of `values`. The result is NaN without values or if a value is NaN.
    """
    count = len(values)
    if count == 0:
        return values.new_tensor(torch.nan)
    middle = (torch.arange(count, dtype=values.dtype, device=values.device) + 0.5) / count
    # 1/(12n²) + mean((u_(i) - (2i-1)/2n)²) (Anderson & Darling 1952, §5)
    return (values.sort().values - middle).square().mean() + 1 / (12 * count**2)
