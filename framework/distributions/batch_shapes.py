"""Densities with a changed batch_shape: `Stacked` makes one batch of several densities, `Reshaped` reshapes a batch."""

from collections.abc import Collection, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.distributions import protocol
from framework.distributions.description import DerivedDensity, PlainDensity
from framework.distributions.shapes import broadcast_shapes, unravel_index


class Stacked(PlainDensity):
    """One density with batch_shape (*batch, K), made of K densities with batch_shape (*batch,).

    A `Mixture` reads its components in this form.

    Args:
        densities: the K densities, at least one; all have the same batch_shape, event_shape and support.
    """

    def __init__(self, densities: Sequence[Distribution]) -> None:
        first = densities[0]
        shapes = [(tuple(density.batch_shape), tuple(density.event_shape)) for density in densities]
        if any(shape != shapes[0] for shape in shapes):
            raise ValueError(
                f"The densities to be stacked have different (batch_shape, event_shape): {sorted(set(shapes))}; "
                "expected equal shapes. Stack only densities of the same target."
            )
        self.densities = tuple(densities)
        self.has_enumerate_support = first.has_enumerate_support
        shape = torch.Size((*first.batch_shape, len(densities)))
        super().__init__(shape, first.event_shape, validate_args=False)

    @property
    def support(self) -> constraints.Constraint | None:
        return self.densities[0].support

    def enumerate_support(self, expand: bool = True) -> Tensor:
        """Return every class, (class, *batch, K); without `expand`, all dimensions after the first have length 1."""
        labels = self.densities[0].enumerate_support(expand).unsqueeze(-1)
        return labels.expand(*labels.shape[:-1], len(self.densities)) if expand else labels

    @property
    def _axis(self) -> int:
        """Dimension of a value tensor (*sample, *batch, K, *event) that counts the K densities, as a negative index."""
        return -1 - len(self.event_shape)

    def log_prob(self, value: Tensor) -> Tensor:
        return torch.stack([density.log_prob(part) for density, part in self.pair_with_values(value)], -1)

    def pair_with_values(self, value: Tensor) -> list[tuple[Distribution, Tensor]]:
        """Return a pair for each of the K densities: the density, and the values at which it is evaluated.

        Args:
            value: values (*sample, *batch, K, *event), or (*sample, *batch, 1, *event), the same for all densities.
        """
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


class Reshaped(DerivedDensity):
    """A density whose batch_shape is replaced by another one; number and order of the items stay the same.

    Args:
        density: the wrapped density, with any batch_shape.
        batch_shape: the new batch_shape.
    """

    def __init__(self, density: Distribution, batch_shape: torch.Size | tuple[int, ...]) -> None:
        shape = torch.Size(batch_shape)
        # a size that is not known yet, as in the trace of an exported model, must not be compared
        if not torch.compiler.is_exporting() and shape.numel() != density.batch_shape.numel():
            raise ValueError(
                f"A batch of densities with batch_shape {tuple(density.batch_shape)} cannot get the batch_shape "
                f"{tuple(shape)}; expected the same number of densities."
            )
        super().__init__(density, shape)
        self.has_enumerate_support = density.has_enumerate_support

    def enumerate_support(self, expand: bool = True) -> Tensor:
        """Return every class, (class, *batch); without `expand`, all dimensions after the first have length 1."""
        labels = self.density.enumerate_support(expand=False).reshape(-1, *(1,) * len(self.batch_shape))
        return labels.expand(-1, *self.batch_shape) if expand else labels

    def log_prob(self, value: Tensor) -> Tensor:
        flat, shape = self.inner(value)
        return self.density.log_prob(flat).reshape(shape)

    def inner(self, value: Tensor) -> tuple[Tensor, torch.Size]:
        """Return `value` in the batch_shape of the wrapped density, and the shape that results of log_prob must have.

        Args:
            value: values (*sample, *batch, *event) in the new batch_shape. The result of log_prob is (*sample, *batch).
        """
        whole = broadcast_shapes(value.shape, torch.Size((*self.batch_shape, *self.event_shape)))
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


def _register_density(function: Any) -> None:
    """Register methods of a function (density, argument) → density for `Stacked` and `Reshaped`.

    They apply the function to the wrapped densities, and stack or reshape the results.
    """

    @function.register
    def _(density: Stacked, argument: Any) -> Distribution:
        return Stacked([function(inner, argument) for inner in density.densities])

    @function.register
    def _(density: Reshaped, argument: Any) -> Distribution:
        return Reshaped(function(density.density, argument), density.batch_shape)


_register_density(protocol.marginal)
_register_density(protocol.tempered_density)


@protocol.median.register
def _(density: Stacked, samples: int) -> Tensor:
    axis = -1 - len(density.event_shape)
    return torch.stack([protocol.median(inner, samples) for inner in density.densities], axis)


@protocol.median.register
def _(density: Reshaped, samples: int) -> Tensor:
    return protocol.median(density.density, samples).reshape(*density.batch_shape, *density.event_shape)


@protocol.estimate.register
def _(density: Stacked, value: Tensor) -> protocol.Estimate:
    parts = [protocol.estimate(inner, part) for inner, part in density.pair_with_values(value)]
    return protocol.Estimate(*(torch.stack(fields, -1) for fields in zip(*parts, strict=True)))


@protocol.estimate.register
def _(density: Reshaped, value: Tensor) -> protocol.Estimate:
    flat, shape = density.inner(value)
    return protocol.estimate(density.density, flat).map_fields(lambda field: field.reshape(shape))


def _register_number(function: Any) -> None:
    """Register methods of a function (density, value) → tensor for `Stacked` and `Reshaped`.

    They apply the function to the wrapped densities, and stack or reshape the results. The function returns a tensor
    (*sample, *batch) or None.
    """

    @function.register
    def _(density: Stacked, value: Tensor) -> Tensor | None:
        return _stack([function(inner, part) for inner, part in density.pair_with_values(value)])

    @function.register
    def _(density: Reshaped, value: Tensor) -> Tensor | None:
        flat, shape = density.inner(value)
        return _reshape(function(density.density, flat), shape)


_register_number(protocol.cdf)
_register_number(protocol.mahalanobis)


@protocol.marginal_cdfs.register
def _(density: Stacked, value: Tensor) -> Tensor | None:
    return _stack(
        [protocol.marginal_cdfs(inner, part) for inner, part in density.pair_with_values(value)],
        -1 - len(density.event_shape),
    )


@protocol.marginal_cdfs.register
def _(density: Reshaped, value: Tensor) -> Tensor | None:
    flat, shape = density.inner(value)
    return _reshape(protocol.marginal_cdfs(density.density, flat), shape + density.event_shape)


@protocol.arc_probability.register
def _(density: Stacked, start: Tensor, end: Tensor) -> Tensor | None:
    both = zip(density.pair_with_values(start), density.pair_with_values(end), strict=True)
    return _stack([protocol.arc_probability(inner, first, last) for (inner, first), (_, last) in both])


@protocol.arc_probability.register
def _(density: Reshaped, start: Tensor, end: Tensor) -> Tensor | None:
    start, end = torch.broadcast_tensors(start, end)
    flat, shape = density.inner(start)
    return _reshape(protocol.arc_probability(density.density, flat, density.inner(end)[0]), shape)


@protocol.trigonometric_moments.register
def _(density: Stacked, count: int, weights: Tensor | None = None) -> Tensor | None:
    moments = _stack([protocol.trigonometric_moments(inner, count) for inner in density.densities])
    return protocol.weighted_moments(moments, weights)


@protocol.trigonometric_moments.register
def _(density: Reshaped, count: int, weights: Tensor | None = None) -> Tensor | None:
    moments = protocol.trigonometric_moments(density.density, count)
    return protocol.weighted_moments(_reshape(moments, torch.Size((count, *density.batch_shape))), weights)


@protocol.normals.register
def _(density: Stacked) -> protocol.Normals | None:
    parts = [part for part in map(protocol.normals, density.densities) if part is not None]
    if len(parts) < len(density.densities) or len({part.mean.shape for part in parts}) > 1:
        return None
    return protocol.Normals(*(torch.stack(numbers, -2) for numbers in zip(*parts, strict=True)))


@protocol.normals.register
def _(density: Reshaped) -> protocol.Normals | None:
    parts = protocol.normals(density.density)
    if parts is None:
        return None
    return protocol.Normals(*(number.reshape(*density.batch_shape, number.shape[-1]) for number in parts))


@protocol.quadratic_bound.register
def _(density: Stacked, value: Tensor) -> protocol.QuadraticBound | None:
    parts = [protocol.quadratic_bound(inner, part) for inner, part in density.pair_with_values(value)]
    known = [part for part in parts if part is not None]
    if len(known) < len(parts):
        return None
    log_prob, *bounds = zip(*known, strict=True)
    return protocol.QuadraticBound(torch.stack(log_prob, -1), *(torch.stack(field, -2) for field in bounds))


@protocol.quadratic_bound.register
def _(density: Reshaped, value: Tensor) -> protocol.QuadraticBound | None:
    flat, shape = density.inner(value)
    bound = protocol.quadratic_bound(density.density, flat)
    if bound is None:
        return None
    log_prob, *bounds = bound
    return protocol.QuadraticBound(
        log_prob.reshape(shape), *(field.reshape(*shape, *density.event_shape) for field in bounds)
    )


@protocol.images.register
def _(density: Stacked, channels: Collection[str]) -> dict[str, Tensor]:
    parts = [protocol.images(inner, channels) for inner in density.densities]
    axis = len(density.batch_shape) - 1
    return {name: torch.stack([part[name] for part in parts], axis) for name in parts[0]}


@protocol.images.register
def _(density: Reshaped, channels: Collection[str]) -> dict[str, Tensor]:
    inner_dimensions = len(density.density.batch_shape)
    inner_images = protocol.images(density.density, channels)
    return {
        name: image.reshape(*density.batch_shape, *image.shape[inner_dimensions:])
        for name, image in inner_images.items()
    }


@protocol.mode_candidates.register
def _(density: Stacked) -> Tensor:
    return _stack_padded(
        [protocol.mode_candidates(inner) for inner in density.densities], -1 - len(density.event_shape)
    )


@protocol.mode_candidates.register
def _(density: Reshaped) -> Tensor:
    return protocol.mode_candidates(density.density).reshape(-1, *density.batch_shape, *density.event_shape)


@protocol.peak_widths.register
def _(density: Stacked) -> Tensor:
    return _stack_padded([protocol.peak_widths(inner) for inner in density.densities], -1)


@protocol.peak_widths.register
def _(density: Reshaped) -> Tensor:
    return protocol.peak_widths(density.density).reshape(-1, *density.batch_shape)


def _stack_padded(candidates: list[Tensor], axis: int) -> Tensor:
    """Stack tensors (candidate, …) of several densities; a density with fewer mode candidates repeats its first one.

    Args:
        candidates: mode candidates or peak widths of each density.
        axis: dimension along which the tensors are stacked.
    """
    largest_count = max(len(tensor) for tensor in candidates)
    padded = [
        torch.cat([tensor, tensor[:1].expand(largest_count - len(tensor), *tensor.shape[1:])])
        for tensor in candidates
    ]
    return torch.stack(padded, axis)


@protocol.recentre.register
def _(density: Stacked, index: tuple[Tensor, ...], origin: Tensor) -> Distribution:
    *item, number = index
    every = torch.arange(len(density.densities), device=number.device)
    if number.shape != every.shape or any(part.shape[-1:] != (1,) for part in (*item, origin[..., 0])):
        return protocol.recentre.dispatch(Distribution)(density, index, origin)
    item = tuple(part.squeeze(-1) for part in item)
    return Stacked([protocol.recentre(inner, item, origin.squeeze(-2)) for inner in density.densities])


@protocol.recentre.register
def _(density: Reshaped, index: tuple[Tensor, ...], origin: Tensor) -> Distribution:
    item = torch.zeros((), dtype=torch.int64, device=origin.device)
    for part, size in zip(index, density.batch_shape, strict=True):
        item = item * size + part
    inner = density.density
    return protocol.recentre(inner, unravel_index(item, inner.batch_shape), origin)


def _stack(parts: list[Tensor | None], axis: int = -1) -> Tensor | None:
    known = [part for part in parts if part is not None]
    return torch.stack(known, axis) if len(known) == len(parts) else None


def _reshape(result: Tensor | None, shape: torch.Size) -> Tensor | None:
    return None if result is None else result.reshape(shape)
