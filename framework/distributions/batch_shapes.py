"""Densities with a changed batch_shape: several densities side by side, or one reshaped batch; wrappers mix these."""

from collections.abc import Collection, Sequence
from typing import ClassVar

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.distributions.description import one_line
from framework.distributions.protocol import (
    Estimate,
    Normals,
    QuadraticBound,
    arc_probability,
    cdf,
    estimate,
    images,
    mahalanobis,
    marginal,
    marginal_cdfs,
    median,
    mode_candidates,
    normals,
    peak_widths,
    quadratic_bound,
    recentre,
    tempered_density,
)


class Stacked(Distribution):
    """K densities of one batch_shape side by side, with batch_shape (*batch, K), the form that a Mixture reads.

    Args:
        densities: at least one; all have the same batch_shape, event_shape and support.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}
    has_rsample = False
    __repr__ = one_line

    def __init__(self, densities: Sequence[Distribution]) -> None:
        first = densities[0]
        shapes = {(tuple(one.batch_shape), tuple(one.event_shape)) for one in densities}
        if len(shapes) > 1:
            raise ValueError(f"densities differ in (batch_shape, event_shape): {sorted(shapes)}; wanted one.")
        self.densities = tuple(densities)
        self.has_enumerate_support = first.has_enumerate_support
        shape = torch.Size((*first.batch_shape, len(densities)))
        super().__init__(shape, first.event_shape, validate_args=False)

    @property
    def support(self) -> constraints.Constraint | None:
        return self.densities[0].support

    def enumerate_support(self, expand: bool = True) -> Tensor:
        """Return every class, (class, *batch, K), or (class, *1) without `expand`."""
        found = self.densities[0].enumerate_support(expand).unsqueeze(-1)
        return found.expand(*found.shape[:-1], len(self.densities)) if expand else found

    @property
    def _axis(self) -> int:
        """The dimension of a value tensor that counts the K densities."""
        return -1 - len(self.event_shape)

    def log_prob(self, value: Tensor) -> Tensor:
        return torch.stack([density.log_prob(part) for density, part in self.apart(value)], -1)

    def apart(self, value: Tensor) -> list[tuple[Distribution, Tensor]]:
        """Return each density with its own part of the values (*sample, *batch, K or 1, *event)."""
        wide = value.expand(*value.shape[: self._axis], len(self.densities), *self.event_shape)
        return list(zip(self.densities, wide.unbind(self._axis), strict=True))

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape)
        return torch.stack([density.sample(shape) for density in self.densities], self._axis)

    @property
    def mode(self) -> Tensor:
        return torch.stack([density.mode for density in self.densities], self._axis)

    @property
    def mean(self) -> Tensor:
        return torch.stack([density.mean for density in self.densities], self._axis)

    @property
    def variance(self) -> Tensor:
        return torch.stack([density.variance for density in self.densities], self._axis)

    def entropy(self) -> Tensor:
        return torch.stack([density.entropy() for density in self.densities], -1)


class Reshaped(Distribution):
    """One density whose batch is read in another shape with the same number of items, in the same order.

    Args:
        density: a density with any batch_shape.
        batch_shape: the new shape, with as many items.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}
    has_rsample = False
    __repr__ = one_line

    def __init__(self, density: Distribution, batch_shape: torch.Size | tuple[int, ...]) -> None:
        shape = torch.Size(batch_shape)
        if shape.numel() != density.batch_shape.numel():
            raise ValueError(
                f"a batch of shape {tuple(density.batch_shape)} cannot be read as {tuple(shape)}; wanted as many items."
            )
        self.density = density
        self.has_enumerate_support = density.has_enumerate_support
        super().__init__(shape, density.event_shape, validate_args=False)

    @property
    def support(self) -> constraints.Constraint | None:
        return self.density.support

    def enumerate_support(self, expand: bool = True) -> Tensor:
        """Return every class, (class, *batch), or (class, *1) without `expand`."""
        found = self.density.enumerate_support(expand=False).reshape(-1, *(1,) * len(self.batch_shape))
        return found.expand(-1, *self.batch_shape) if expand else found

    def log_prob(self, value: Tensor) -> Tensor:
        flat, shape = self.inner(value)
        return self.density.log_prob(flat).reshape(shape)

    def inner(self, value: Tensor) -> tuple[Tensor, torch.Size]:
        """Return the values in the batch_shape of the inner density, and the shape of the result.

        Args:
            value: values (*sample, *batch, *event) in the new batch_shape.
        """
        whole = torch.broadcast_shapes(value.shape, torch.Size((*self.batch_shape, *self.event_shape)))
        lead = whole[: len(whole) - len(self.batch_shape) - len(self.event_shape)]
        flat = value.expand(whole).reshape(*lead, *self.density.batch_shape, *self.event_shape)
        return flat, torch.Size((*lead, *self.batch_shape))

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape)
        return self.density.sample(shape).reshape(*shape, *self.batch_shape, *self.event_shape)

    @property
    def mode(self) -> Tensor:
        return self.density.mode.reshape(*self.batch_shape, *self.event_shape)

    @property
    def mean(self) -> Tensor:
        return self.density.mean.reshape(*self.batch_shape, *self.event_shape)

    @property
    def variance(self) -> Tensor:
        return self.density.variance.reshape(*self.batch_shape, *self.event_shape)

    def entropy(self) -> Tensor:
        return self.density.entropy().reshape(self.batch_shape)


@marginal.register
def _(density: Stacked, index: int) -> Stacked:
    return Stacked([marginal(one, index) for one in density.densities])


@marginal.register
def _(density: Reshaped, index: int) -> Reshaped:
    return Reshaped(marginal(density.density, index), density.batch_shape)


@tempered_density.register
def _(density: Stacked, temperature: Tensor) -> Distribution:
    return Stacked([tempered_density(one, temperature) for one in density.densities])


@tempered_density.register
def _(density: Reshaped, temperature: Tensor) -> Distribution:
    return Reshaped(tempered_density(density.density, temperature), density.batch_shape)


@median.register
def _(density: Stacked, samples: int) -> Tensor:
    axis = -1 - len(density.event_shape)
    return torch.stack([median(one, samples) for one in density.densities], axis)


@median.register
def _(density: Reshaped, samples: int) -> Tensor:
    return median(density.density, samples).reshape(*density.batch_shape, *density.event_shape)


@estimate.register
def _(density: Stacked, value: Tensor) -> Estimate:
    parts = [estimate(one, part) for one, part in density.apart(value)]
    return Estimate(*(torch.stack(fields, -1) for fields in zip(*parts, strict=True)))


@estimate.register
def _(density: Reshaped, value: Tensor) -> Estimate:
    flat, shape = density.inner(value)
    return estimate(density.density, flat).each(lambda field: field.reshape(shape))


@cdf.register
def _(density: Stacked, value: Tensor) -> Tensor | None:
    return _stacked([cdf(one, part) for one, part in density.apart(value)])


@cdf.register
def _(density: Reshaped, value: Tensor) -> Tensor | None:
    flat, shape = density.inner(value)
    return _folded(cdf(density.density, flat), shape)


@marginal_cdfs.register
def _(density: Stacked, value: Tensor) -> Tensor | None:
    return _stacked(
        [marginal_cdfs(one, part) for one, part in density.apart(value)], -1 - len(density.event_shape)
    )


@marginal_cdfs.register
def _(density: Reshaped, value: Tensor) -> Tensor | None:
    flat, shape = density.inner(value)
    return _folded(marginal_cdfs(density.density, flat), shape + density.event_shape)


@arc_probability.register
def _(density: Stacked, start: Tensor, end: Tensor) -> Tensor | None:
    both = zip(density.apart(start), density.apart(end), strict=True)
    return _stacked([arc_probability(one, first, last) for (one, first), (_, last) in both])


@arc_probability.register
def _(density: Reshaped, start: Tensor, end: Tensor) -> Tensor | None:
    start, end = torch.broadcast_tensors(start, end)
    flat, shape = density.inner(start)
    return _folded(arc_probability(density.density, flat, density.inner(end)[0]), shape)


@mahalanobis.register
def _(density: Stacked, value: Tensor) -> Tensor | None:
    return _stacked([mahalanobis(one, part) for one, part in density.apart(value)])


@mahalanobis.register
def _(density: Reshaped, value: Tensor) -> Tensor | None:
    flat, shape = density.inner(value)
    return _folded(mahalanobis(density.density, flat), shape)


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


@quadratic_bound.register
def _(density: Stacked, value: Tensor) -> QuadraticBound | None:
    parts = [quadratic_bound(one, part) for one, part in density.apart(value)]
    known = [part for part in parts if part is not None]
    if len(known) < len(parts):
        return None
    log_prob, *others = zip(*known, strict=True)
    return QuadraticBound(torch.stack(log_prob, -1), *(torch.stack(each, -2) for each in others))


@quadratic_bound.register
def _(density: Reshaped, value: Tensor) -> QuadraticBound | None:
    flat, shape = density.inner(value)
    found = quadratic_bound(density.density, flat)
    if found is None:
        return None
    log_prob, *others = found
    return QuadraticBound(
        log_prob.reshape(shape), *(each.reshape(*shape, *density.event_shape) for each in others)
    )


@images.register
def _(density: Stacked, channels: Collection[str]) -> dict[str, Tensor]:
    parts = [images(one, channels) for one in density.densities]
    axis = len(density.batch_shape) - 1
    return {name: torch.stack([part[name] for part in parts], axis) for name in parts[0]}


@images.register
def _(density: Reshaped, channels: Collection[str]) -> dict[str, Tensor]:
    inner = len(density.density.batch_shape)
    found = images(density.density, channels)
    return {name: one.reshape(*density.batch_shape, *one.shape[inner:]) for name, one in found.items()}


@mode_candidates.register
def _(density: Stacked) -> Tensor:
    return _beside([mode_candidates(one) for one in density.densities], -1 - len(density.event_shape))


@mode_candidates.register
def _(density: Reshaped) -> Tensor:
    return mode_candidates(density.density).reshape(-1, *density.batch_shape, *density.event_shape)


@peak_widths.register
def _(density: Stacked) -> Tensor:
    return _beside([peak_widths(one) for one in density.densities], -1)


@peak_widths.register
def _(density: Reshaped) -> Tensor:
    return peak_widths(density.density).reshape(-1, *density.batch_shape)


def _beside(found: list[Tensor], axis: int) -> Tensor:
    """Stack tensors (peak, …) of several densities; a density with fewer peaks repeats its first peak."""
    most = max(len(one) for one in found)
    same = [torch.cat([one, one[:1].expand(most - len(one), *one.shape[1:])]) for one in found]
    return torch.stack(same, axis)


@recentre.register
def _(density: Stacked, index: tuple[Tensor, ...], place: Tensor) -> Distribution:
    *item, number = index
    every = torch.arange(len(density.densities), device=number.device)
    if number.shape != every.shape or any(part.shape[-1:] != (1,) for part in (*item, place[..., 0])):
        return recentre.dispatch(Distribution)(density, index, place)
    item = tuple(part.squeeze(-1) for part in item)
    return Stacked([recentre(one, item, place.squeeze(-2)) for one in density.densities])


@recentre.register
def _(density: Reshaped, index: tuple[Tensor, ...], place: Tensor) -> Distribution:
    item = torch.zeros((), dtype=torch.int64, device=place.device)
    for part, size in zip(index, density.batch_shape, strict=True):
        item = item * size + part
    inner = density.density
    return recentre(inner, torch.unravel_index(item, inner.batch_shape), place)


def _stacked(parts: list[Tensor | None], axis: int = -1) -> Tensor | None:
    known = [part for part in parts if part is not None]
    return torch.stack(known, axis) if len(known) == len(parts) else None


def _folded(found: Tensor | None, shape: torch.Size) -> Tensor | None:
    return None if found is None else found.reshape(shape)
