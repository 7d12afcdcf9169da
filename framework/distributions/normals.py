"""What mixtures of normal densities know in closed form, however they are wrapped; a normal density registers here."""

from functools import singledispatch
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, MultivariateNormal, Normal

from framework.distributions.batch_shapes import Reshaped, Stacked
from framework.distributions.density import Mixture


class Normals(NamedTuple):
    """A mixture of normals over one real: log-weights, means and standard deviations, (*batch, component), float64."""

    log_weights: Tensor
    mean: Tensor
    scale: Tensor


@singledispatch
def normals(density: Distribution) -> Normals | None:
    """The normals that a density of one real, event_shape (1,), is a mixture of; None where none are known.

    A normal density registers its own: `@normals.register`, and `one_normal` makes the answer.
    """
    return None


def one_normal(mean: Tensor, scale: Tensor) -> Normals:
    """The answer of one that is normal itself; both of shape (*batch, 1)."""
    mean = mean.double()
    return Normals(torch.zeros_like(mean), mean, scale.double())


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


@normals.register
def _(density: Mixture) -> Normals | None:
    parts = normals(density.components)  # (*batch, K, k)
    if parts is None:
        return None
    # again: float32's sum to 1 but for 1e-7
    log_weights = density.log_weights.double().log_softmax(-1).unsqueeze(-1) + parts.log_weights
    return Normals(*(number.flatten(-2) for number in (log_weights, parts.mean, parts.scale)))


@normals.register
def _(density: Stacked) -> Normals | None:
    parts = [part for part in map(normals, density.densities) if part is not None]
    if len(parts) < len(density.densities) or len({part.mean.shape for part in parts}) > 1:
        return None
    return Normals(*(torch.stack(numbers, -2) for numbers in zip(*parts, strict=True)))


@normals.register
def _(density: Reshaped) -> Normals | None:
    parts = normals(density.density)
    if parts is None:
        return None
    return Normals(*(number.reshape(*density.batch_shape, number.shape[-1]) for number in parts))


@singledispatch
def mahalanobis(density: Distribution, value: Tensor) -> Tensor | None:
    """(y - μ)ᵀ Σ⁻¹ (y - μ) of a normal density over any number of reals, (*batch), float64; None of any other.

    A normal density registers its own: `@mahalanobis.register`.
    """
    return None


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


@mahalanobis.register
def _(density: Mixture, value: Tensor) -> Tensor | None:
    if density.log_weights.shape[-1] > 1:
        return None
    found = mahalanobis(density.components, value.unsqueeze(-2))
    return None if found is None else found.squeeze(-1)


@mahalanobis.register
def _(density: Reshaped, value: Tensor) -> Tensor | None:
    inner = density.density
    found = mahalanobis(inner, value.reshape(*inner.batch_shape, *inner.event_shape))
    return None if found is None else found.reshape(density.batch_shape)
