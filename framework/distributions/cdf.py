"""Masses of intervals and arcs, of densities that know them in closed form; a density registers its own."""

import math
from functools import singledispatch

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.batch_shapes import Reshaped, Stacked
from framework.distributions.density import Mixture
from framework.distributions.normals import normals


@singledispatch
def cdf(density: Distribution, value: Tensor) -> Tensor | None:
    """P(X ≤ y) of a density of one real, float64; None where it is not known, and draws have to say.

    Exact of every mixture of normals. Another density registers its own: `@cdf.register`.

    Args:
        value: (*sample, *batch, 1); the answer is (*sample, *batch).
    """
    found = normals(density)
    if found is None:
        return None
    residual = value.double() - found.mean
    # a point mass counts half at its place
    standard = torch.where(residual == 0, residual, residual / found.scale)
    weights = found.log_weights.exp()
    below = torch.where(weights > 0, weights * torch.special.ndtr(standard), 0.0)
    return below.sum(-1).clamp(max=1)


@cdf.register
def _(density: Mixture, value: Tensor) -> Tensor | None:
    found = cdf.dispatch(Distribution)(density, value)
    if found is not None:
        return found
    parts = cdf(density.components, value.unsqueeze(-2))
    return None if parts is None else _mixed(density, parts)


@cdf.register
def _(density: Stacked, value: Tensor) -> Tensor | None:
    count = len(density.densities)
    wide = value.expand(*value.shape[:-2], count, 1)
    parts = [cdf(one, part) for one, part in zip(density.densities, wide.unbind(-2), strict=True)]
    return _stacked(parts)


@cdf.register
def _(density: Reshaped, value: Tensor) -> Tensor | None:
    flat, shape = _flat(density, value)
    found = cdf(density.density, flat)
    return None if found is None else found.reshape(shape)


@singledispatch
def arc(density: Distribution, start: Tensor, end: Tensor) -> Tensor | None:
    """Mass of the arc from `start` counter-clockwise to `end` of a density of one angle; None where it is not known.

    The arc is less than a whole turn; of equal ends it is empty. A density registers its own: `@arc.register`. Of one
    that has not, `framework.distributions.circular_moments` gives the mass where it is not too narrow.

    Args:
        start, end: (*sample, *batch, 1), radians; the answer is (*sample, *batch), float64.
    """
    return None


@arc.register
def _(density: Mixture, start: Tensor, end: Tensor) -> Tensor | None:
    parts = arc(density.components, start.unsqueeze(-2), end.unsqueeze(-2))
    return None if parts is None else _mixed(density, parts)


@arc.register
def _(density: Stacked, start: Tensor, end: Tensor) -> Tensor | None:
    count = len(density.densities)
    first, last = (value.expand(*value.shape[:-2], count, 1).unbind(-2) for value in (start, end))
    return _stacked([arc(*one) for one in zip(density.densities, first, last, strict=True)])


@arc.register
def _(density: Reshaped, start: Tensor, end: Tensor) -> Tensor | None:
    first, last = torch.broadcast_tensors(start, end)
    flat, shape = _flat(density, first)
    found = arc(density.density, flat, _flat(density, last)[0])
    return None if found is None else found.reshape(shape)


def turn(start: Tensor, end: Tensor) -> Tensor:
    """How far it is from `start` counter-clockwise to `end`, radians in [0, 2π], float64."""
    return torch.remainder(end.double() - start.double(), 2 * math.pi)


def _mixed(density: Mixture, parts: Tensor) -> Tensor:
    weights = density.log_weights.double().softmax(-1)  # float32's sum to 1 but for 1e-7
    return torch.where(weights > 0, weights * parts, 0.0).sum(-1).clamp(0, 1)


def _stacked(parts: list[Tensor | None]) -> Tensor | None:
    known = [part for part in parts if part is not None]
    return torch.stack(known, -1) if len(known) == len(parts) else None


def _flat(density: Reshaped, value: Tensor) -> tuple[Tensor, torch.Size]:
    """Values in the inner density's order of the batch, and the shape of the answer."""
    whole = torch.broadcast_shapes(value.shape, torch.Size((*density.batch_shape, 1)))
    lead = whole[: len(whole) - len(density.batch_shape) - 1]
    flat = value.expand(whole).reshape(*lead, *density.density.batch_shape, 1)
    return flat, whole[:-1]
