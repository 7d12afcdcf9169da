"""The functions of `protocol` in closed form for torch's own densities, and the normal quantile."""

import inspect
from collections.abc import Callable, Collection
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch import distributions as torchs
from torch.distributions import Categorical, Distribution, Independent, MultivariateNormal, Normal

from framework.distributions import protocol
from framework.distributions.description import CategoricalDensity
from framework.distributions.shapes import broadcast_shapes

for _kind in (
    *(torchs.ExponentialFamily, torchs.Categorical, torchs.OneHotCategorical, torchs.MultivariateNormal),
    *(torchs.LowRankMultivariateNormal, torchs.Cauchy, torchs.Gumbel, torchs.HalfNormal, torchs.Laplace),
    *(torchs.StudentT, torchs.Uniform, torchs.VonMises, torchs.Weibull),
):
    protocol.estimate.register(_kind, protocol.exact_estimate)


@protocol.estimate.register
def _(density: Independent, value: Tensor) -> protocol.Estimate:
    """Return the estimate for a product of independent densities; the squared errors of their log-densities add up."""
    factors = protocol.estimate(density.base_dist, value)
    count = density.reinterpreted_batch_ndims
    if count:
        factors = factors.map_fields(lambda field: field.flatten(-count))
    else:
        factors = factors.map_fields(lambda field: field.unsqueeze(-1))
    log_mean, debiased = factors.log_mean.sum(-1), factors.debiased.sum(-1)
    error = factors.standard_error.square().sum(-1).sqrt()
    return protocol.Estimate(log_mean, debiased, error, factors.samples.sum(-1), factors.unresolved.any(-1))


_ON_THE_LINE = (Normal, torchs.Laplace, torchs.Cauchy, torchs.Gumbel, torchs.StudentT)
"""Classes of densities over all real numbers whose distribution function torch or SciPy computes.

torch's densities over a part of the real line are missing: their `cdf` is wrong outside of this part.
"""


@protocol.marginal.register
def _(density: Independent, index: int) -> Distribution:
    """Return the marginal of a product of independent densities, which is the density of number `index`."""
    if density.event_shape == (1,) and index == 0:
        return density
    if density.reinterpreted_batch_ndims == 0:
        return protocol.marginal(density.base_dist, index)
    base = _change_parameters(density.base_dist, lambda parameter: parameter[..., index : index + 1])
    if base is None or density.reinterpreted_batch_ndims != 1:
        return protocol.marginal.dispatch(Distribution)(density, index)
    return Independent(base, 1, validate_args=False)


def _change_parameters(density: Distribution, change: Callable[[Tensor], Tensor]) -> Distribution | None:
    """Return a torch density with `change` applied to each of its parameters; None if they are not known.

    The parameters are known if event_shape is () and every argument of the constructor is a tensor with one number for
    each item of the batch. They are not known for a mixture or a transformed density, whose arguments are other
    densities.
    """
    kind: Any = next(base for base in type(density).__mro__ if getattr(torchs, base.__name__, None) is base)
    names = {*inspect.signature(kind.__init__).parameters} - {"self", "validate_args"}
    # one of the two was given; torch computes the other with rounding errors
    if {"probs", "logits"} <= names:
        names -= {"probs"} if "logits" in vars(density) else {"logits"}
    shape = None if density.event_shape else density.batch_shape
    changed: dict[str, Tensor] = {}
    for name in names:
        parameter = getattr(density, name, None)
        if not isinstance(parameter, Tensor) or parameter.shape != shape:
            return None
        changed[name] = change(parameter)
    return kind(**changed, validate_args=False)


def _distribution_function(base: Distribution, value: Tensor) -> Tensor:
    """Return P(X ≤ value), float64, of a density whose class is in `_ON_THE_LINE`.

    Student's t is computed by SciPy, because torch has no distribution function for it.
    """
    if not isinstance(base, torchs.StudentT):
        return base.cdf(value)
    # imported here, since importing SciPy is slow and most commands do not need it
    from scipy.special import stdtr

    freedom, standard = torch.broadcast_tensors(base.df, (value - base.loc) / base.scale)
    return torch.from_numpy(stdtr(freedom.cpu().numpy(), standard.cpu().numpy())).to(value.device)


@protocol.marginal_cdfs.register
def _(density: Independent, value: Tensor) -> Tensor | None:
    if isinstance(density.base_dist, _ON_THE_LINE):
        base = _change_parameters(density.base_dist, Tensor.double)
        if base is not None:
            return _distribution_function(base, value.double())
    return (
        None
        if len(density.event_shape) == 3
        else protocol.marginal_cdfs.dispatch(Distribution)(density, value)
    )


@protocol.cdf.register
def _(density: Independent, value: Tensor) -> Tensor | None:
    known = isinstance(density.base_dist, _ON_THE_LINE) and density.event_shape == (1,)
    # `normals` also handles a normal density of width 0
    probabilities = (
        protocol.marginal_cdfs(density, value) if known and protocol.normals(density) is None else None
    )
    return (
        protocol.cdf.dispatch(Distribution)(density, value)
        if probabilities is None
        else probabilities.squeeze(-1)
    )


@protocol.marginal.register
def _(density: MultivariateNormal, index: int) -> MultivariateNormal:
    if density.event_shape == (1,) and index == 0:
        return density
    column = slice(index, index + 1)
    scale = density.variance[..., column].sqrt().unsqueeze(-1)
    return MultivariateNormal(density.loc[..., column], scale_tril=scale, validate_args=False)


@protocol.median.register
def _(density: MultivariateNormal, samples: int) -> Tensor:
    # each number's marginal is symmetric about its mean
    return density.loc


@protocol.pick.register
def _(density: Categorical, index: Tensor) -> Distribution:
    return CategoricalDensity(logits=protocol.take(density.logits, index), validate_args=False)


@protocol.pick.register
def _(density: Independent, index: Tensor) -> Distribution:
    base = _change_parameters(density.base_dist, lambda parameter: protocol.take(parameter, index))
    if base is None or density.reinterpreted_batch_ndims != 1:
        return protocol.pick.dispatch(Distribution)(density, index)
    return Independent(base, 1, validate_args=False)


@protocol.quadratic_bound.register
def _(density: Independent, value: Tensor) -> protocol.QuadraticBound | None:
    base = density.base_dist
    if not isinstance(base, Normal) or density.reinterpreted_batch_ndims != 1:
        return None
    stiffness = base.scale.square().reciprocal().expand(broadcast_shapes(value.shape, base.scale.shape))
    return protocol.QuadraticBound(density.log_prob(value), (base.loc - value) * stiffness, stiffness)


@protocol.recentre.register
def _(density: Independent, index: tuple[Tensor, ...], origin: Tensor) -> Distribution:
    base = density.base_dist
    if not isinstance(base, Normal) or density.reinterpreted_batch_ndims != 1:
        return protocol.recentre.dispatch(Distribution)(density, index, origin)
    loc, scale = (parameter.double()[index] for parameter in (base.loc, base.scale))
    return Independent(Normal(loc - origin, scale, validate_args=False), 1, validate_args=False)


@protocol.tempered_density.register
def _(density: Independent, temperature: Tensor) -> Distribution:
    # the power of a product is the product of the powers
    base = protocol.tempered_density(density.base_dist, temperature)
    return Independent(base, density.reinterpreted_batch_ndims, validate_args=False)


@protocol.tempered_density.register
def _(density: Normal, temperature: Tensor) -> Distribution:
    # exp(-d²/2σ²)^(1/T) = exp(-d²/2σ²T)
    return Normal(density.loc, density.scale * temperature.sqrt(), validate_args=False)


@protocol.tempered_density.register
def _(density: MultivariateNormal, temperature: Tensor) -> Distribution:
    scale = density.scale_tril * temperature.sqrt()
    return MultivariateNormal(density.loc, scale_tril=scale, validate_args=False)


@protocol.images.register
def _(density: Independent, channels: Collection[str]) -> dict[str, Tensor]:
    if len(density.event_shape) != 3 or set(channels) != {"color"}:
        return protocol.images.dispatch(Distribution)(density, channels)
    return {"color": density.mean}


@protocol.normals.register
def _(density: Independent) -> protocol.Normals | None:
    base = density.base_dist
    if not isinstance(base, Normal) or tuple(density.event_shape) != (1,):
        return None
    return protocol.one_normal(base.loc, base.scale)


@protocol.normals.register
def _(density: MultivariateNormal) -> protocol.Normals | None:
    if tuple(density.event_shape) != (1,):
        return None
    return protocol.one_normal(density.loc, density.variance.sqrt())


@protocol.mahalanobis.register
def _(density: Independent, value: Tensor) -> Tensor | None:
    base = density.base_dist
    if not isinstance(base, Normal) or len(density.event_shape) != 1:
        return None
    return ((value.double() - base.loc.double()) / base.scale.double()).square().sum(-1)


@protocol.mahalanobis.register
def _(density: MultivariateNormal, value: Tensor) -> Tensor:
    residual = (value.double() - density.loc.double()).unsqueeze(-1)
    standard = torch.linalg.solve_triangular(density.scale_tril.double(), residual, upper=False)
    return standard.squeeze(-1).square().sum(-1)


def normal_quantile(probability: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return z with Φ(z) = probability, where Φ is the distribution function of the standard normal density.

    A probability below 2⁻⁵⁴ gives about -8.3 and not -∞; a probability above 1 - 2⁻⁵³ gives about 8.2 and not ∞. z is
    computed in float64 and has the dtype of the probability.
    """
    exact = probability.double().clamp(2.0**-54, 1 - 2.0**-53)
    quantile = _quantile_in_trace(exact) if torch.compiler.is_exporting() else torch.special.ndtri(exact)
    return quantile.to(probability.dtype)


def _quantile_in_trace(probability: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return the normal quantile by rational functions, for a trace: ONNX has no such operation.

    The relative error is about 1e-16 in float64 (Wichura 1988, algorithm AS 241, PPND16).
    """
    from_middle = probability - 0.5
    tail = torch.sqrt(-torch.log(torch.minimum(probability, 1 - probability)))
    middle, near, far = _ratios(torch.stack([0.180625 - from_middle.square(), tail - 1.6, tail - 5]))
    outer = torch.where(tail <= 5, near, far)
    outer = torch.where(from_middle < 0, -outer, outer)
    return torch.where(from_middle.abs() <= 0.425, middle * from_middle, outer)


def _ratios(arguments: Float[Tensor, "3 *shape"]) -> Float[Tensor, "3 *shape"]:
    """Return the ratios of two polynomials for the middle, the near tail and the far tail.

    All six polynomials are evaluated at once: a trace of each operation by itself takes seconds.
    """
    # by powers, highest first; then numerator and denominator; then the three ratios
    coefficients = torch.tensor([_MIDDLE, _NEAR_TAIL, _FAR_TAIL], dtype=torch.float64).permute(2, 1, 0)
    coefficients = coefficients.to(arguments).reshape(*coefficients.shape, *(1,) * (arguments.dim() - 1))
    value = coefficients[0]
    for coefficient in coefficients[1:]:
        value = value * arguments + coefficient
    return value[0] / value[1]


_MIDDLE = (
    (2509.0809287301226727, 33430.575583588128105, 67265.770927008700853, 45921.953931549871457,
     13731.693765509461125, 1971.5909503065514427, 133.14166789178437745, 3.387132872796366608),
    (5226.495278852545925, 28729.085735721942674, 39307.89580009271061, 21213.794301586595867,
     5394.1960214247511077, 687.1870074920579083, 42.313330701600911252, 1.0),
)  # fmt: skip
_NEAR_TAIL = (
    (7.7454501427834140764e-4, 0.0227238449892691845833, 0.24178072517745061177, 1.27045825245236838258,
     3.64784832476320460504, 5.7694972214606914055, 4.6303378461565452959, 1.42343711074968357734),
    (1.05075007164441684324e-9, 5.475938084995344946e-4, 0.0151986665636164571966, 0.14810397642748007459,
     0.68976733498510000455, 1.6763848301838038494, 2.05319162663775882187, 1.0),
)  # fmt: skip
_FAR_TAIL = (
    (2.01033439929228813265e-7, 2.71155556874348757815e-5, 0.0012426609473880784386, 0.026532189526576123093,
     0.29656057182850489123, 1.7848265399172913358, 5.4637849111641143699, 6.6579046435011037772),
    (2.04426310338993978564e-15, 1.4215117583164458887e-7, 1.8463183175100546818e-5, 7.868691311456132591e-4,
     0.0148753612908506148525, 0.13692988092273580531, 0.59983220655588793769, 1.0),
)  # fmt: skip
