"""What torch's own densities answer in closed form, and the normal quantile."""

from collections.abc import Collection

import torch
from jaxtyping import Float
from torch import Tensor
from torch import distributions as torchs
from torch.distributions import Categorical, Distribution, Independent, MultivariateNormal, Normal

from framework.distributions.protocol import (
    Estimate,
    Normals,
    Slope,
    about,
    each_cdf,
    estimate,
    exactly,
    images,
    mahalanobis,
    marginal,
    median,
    normals,
    one_normal,
    pick,
    slope,
    take,
    tempered,
)
from framework.errors import UserError

for _kind in (
    *(torchs.ExponentialFamily, torchs.Categorical, torchs.OneHotCategorical, torchs.MultivariateNormal),
    *(torchs.LowRankMultivariateNormal, torchs.Cauchy, torchs.Gumbel, torchs.HalfNormal, torchs.Laplace),
    *(torchs.StudentT, torchs.Uniform, torchs.VonMises, torchs.Weibull),
):
    estimate.register(_kind, exactly)


@estimate.register
def _(density: Independent, value: Tensor) -> Estimate:
    """A product of independent factors: squared errors of their logarithms add up."""
    factors = estimate(density.base_dist, value)
    count = density.reinterpreted_batch_ndims
    if count:
        factors = factors.each(lambda field: field.flatten(-count))
    else:
        factors = factors.each(lambda field: field.unsqueeze(-1))
    log_mean, debiased = factors.log_mean.sum(-1), factors.debiased.sum(-1)
    error = factors.standard_error.square().sum(-1).sqrt()
    return Estimate(log_mean, debiased, error, factors.samples.sum(-1), factors.unresolved.any(-1))


@marginal.register
def _(density: Independent, index: int) -> Distribution:
    if density.event_shape == (1,) and index == 0:
        return density
    if not isinstance(density.base_dist, Normal):
        raise UserError(f"No marginal is known for Independent({type(density.base_dist).__name__}).")
    here = slice(index, index + 1)
    base = Normal(density.base_dist.loc[..., here], density.base_dist.scale[..., here], validate_args=False)
    return Independent(base, 1, validate_args=False)


@each_cdf.register
def _(density: Independent, value: Tensor) -> Tensor | None:
    base = density.base_dist
    if not isinstance(base, Normal | torchs.Laplace):
        return None if len(density.event_shape) == 3 else each_cdf.dispatch(Distribution)(density, value)
    return type(base)(base.loc.double(), base.scale.double(), validate_args=False).cdf(value.double())


@marginal.register
def _(density: MultivariateNormal, index: int) -> MultivariateNormal:
    if density.event_shape == (1,) and index == 0:
        return density
    here = slice(index, index + 1)
    scale = density.variance[..., here].sqrt().unsqueeze(-1)
    return MultivariateNormal(density.loc[..., here], scale_tril=scale, validate_args=False)


@median.register
def _(density: MultivariateNormal, samples: int) -> Tensor:
    # each number's marginal is symmetric about its mean
    return density.loc


@pick.register
def _(density: Categorical, index: Tensor) -> Distribution:
    return Categorical(logits=take(density.logits, index), validate_args=False)


@pick.register
def _(density: Independent, index: Tensor) -> Distribution:
    base = density.base_dist
    if not isinstance(base, Normal) or density.reinterpreted_batch_ndims != 1:
        return pick.dispatch(Distribution)(density, index)
    loc, scale = (take(parameter, index) for parameter in (base.loc, base.scale))
    return Independent(Normal(loc, scale, validate_args=False), 1, validate_args=False)


@slope.register
def _(density: Independent, value: Tensor) -> Slope | None:
    base = density.base_dist
    if not isinstance(base, Normal) or density.reinterpreted_batch_ndims != 1:
        return None
    stiffness = base.scale.square().reciprocal().expand(torch.broadcast_shapes(value.shape, base.scale.shape))
    return Slope(density.log_prob(value), (base.loc - value) * stiffness, stiffness)


@about.register
def _(density: Independent, index: tuple[Tensor, ...], place: Tensor) -> Distribution:
    base = density.base_dist
    if not isinstance(base, Normal) or density.reinterpreted_batch_ndims != 1:
        return about.dispatch(Distribution)(density, index, place)
    loc, scale = (parameter.double()[index] for parameter in (base.loc, base.scale))
    return Independent(Normal(loc - place, scale, validate_args=False), 1, validate_args=False)


@tempered.register
def _(density: Independent, temperature: Tensor) -> Distribution:
    # the power of a product is the product of the powers
    base = tempered(density.base_dist, temperature)
    return Independent(base, density.reinterpreted_batch_ndims, validate_args=False)


@tempered.register
def _(density: Normal, temperature: Tensor) -> Distribution:
    # exp(-d²/2σ²)^(1/T) = exp(-d²/2σ²T)
    return Normal(density.loc, density.scale * temperature.sqrt(), validate_args=False)


@tempered.register
def _(density: MultivariateNormal, temperature: Tensor) -> Distribution:
    scale = density.scale_tril * temperature.sqrt()
    return MultivariateNormal(density.loc, scale_tril=scale, validate_args=False)


@images.register
def _(density: Independent, channels: Collection[str]) -> dict[str, Tensor]:
    if len(density.event_shape) != 3 or set(channels) != {"color"}:
        return images.dispatch(Distribution)(density, channels)
    return {"color": density.mean}


@normals.register
def _(density: Independent) -> Normals | None:
    base = density.base_dist
    if not isinstance(base, Normal) or tuple(density.event_shape) != (1,):
        return None
    return one_normal(base.loc, base.scale)


@normals.register
def _(density: MultivariateNormal) -> Normals | None:
    if tuple(density.event_shape) != (1,):
        return None
    return one_normal(density.loc, density.variance.sqrt())


@mahalanobis.register
def _(density: Independent, value: Tensor) -> Tensor | None:
    base = density.base_dist
    if not isinstance(base, Normal) or len(density.event_shape) != 1:
        return None
    return ((value.double() - base.loc.double()) / base.scale.double()).square().sum(-1)


@mahalanobis.register
def _(density: MultivariateNormal, value: Tensor) -> Tensor:
    residual = (value.double() - density.loc.double()).unsqueeze(-1)
    standard = torch.linalg.solve_triangular(density.scale_tril.double(), residual, upper=False)
    return standard.squeeze(-1).square().sum(-1)


def normal_quantile(place: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """z with Φ(z) = place; places of [0, 1) closer to an end than float64 tells apart become ±8.2, never infinite."""
    return torch.special.ndtri(place.clamp(2.0**-54, 1 - 2.0**-53))
