"""The density of an affine transform X = location + scale · Y of real numbers, computed from the density of Y."""

from collections.abc import Collection

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions import protocol
from framework.distributions.description import DerivedDensity


class AffineDensity(DerivedDensity):
    """Density of X = location + scale · Y, for a vector Y of n numbers; each number has its own location and scale.

    Args:
        density: density of Y, event_shape (n,).
        location: numbers that are added, (*batch, n).
        scale: factors, (*batch, n), above 0.
    """

    def __init__(self, density: Distribution, location: Tensor, scale: Tensor) -> None:
        shape = density.batch_shape + density.event_shape
        if len(density.event_shape) != 1 or location.shape != shape or scale.shape != shape:
            raise ValueError(
                f"The location has the shape {tuple(location.shape)} and the scale {tuple(scale.shape)}, but the "
                f"density is over {tuple(shape)}; expected the same shape (*batch, number) for all three."
            )
        super().__init__(density)
        self.location = location
        self.scale = scale

    @property
    def log_volume(self) -> Tensor:
        """Logarithm of the transform's determinant, Σ log scale, (*batch,), nats, which log_prob subtracts."""
        return self.scale.log().sum(-1)

    def inner(self, value: Tensor) -> Tensor:
        """Return the value of the base density for a value of this density: (value - location) / scale."""
        return (value - self.location) / self.scale

    def outer(self, value: Tensor) -> Tensor:
        """Return the value of this density for a value of the base density: location + scale · value."""
        return self.location + self.scale * value

    def log_prob(self, value: Tensor) -> Tensor:
        return self.density.log_prob(self.inner(value)) - self.log_volume

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        return self.outer(self.density.sample(torch.Size(sample_shape)))

    @property
    def mode(self) -> Tensor:
        return self.outer(self.density.mode)

    @property
    def mean(self) -> Tensor:
        return self.outer(self.density.mean)

    @property
    def variance(self) -> Tensor:
        return self.density.variance * self.scale.square()

    def entropy(self) -> Tensor:
        return self.density.entropy() + self.log_volume


@protocol.marginal.register
def _(density: AffineDensity, index: int) -> AffineDensity:
    column = slice(index, index + 1)
    inner = protocol.marginal(density.density, index)
    return AffineDensity(inner, density.location[..., column], density.scale[..., column])


@protocol.median.register
def _(density: AffineDensity, samples: int) -> Tensor:
    return density.outer(protocol.median(density.density, samples))


@protocol.pick.register
def _(density: AffineDensity, index: Tensor) -> AffineDensity:
    parameters = (protocol.take(number, index) for number in (density.location, density.scale))
    return AffineDensity(protocol.pick(density.density, index), *parameters)


@protocol.recentre.register
def _(density: AffineDensity, index: tuple[Tensor, ...], origin: Tensor) -> AffineDensity:
    # X - origin = scale · (Y - y) with y = (origin - location) / scale
    location, scale = (number.double()[index] for number in (density.location, density.scale))
    inner = protocol.recentre(density.density, index, (origin - location) / scale)
    scale = scale.expand((*inner.batch_shape, 1))
    return AffineDensity(inner, torch.zeros_like(scale), scale)


@protocol.tempered_density.register
def _(density: AffineDensity, temperature: Tensor) -> AffineDensity:
    return AffineDensity(
        protocol.tempered_density(density.density, temperature), density.location, density.scale
    )


@protocol.estimate.register
def _(density: AffineDensity, value: Tensor) -> protocol.Estimate:
    inner_estimate = protocol.estimate(density.density, density.inner(value))
    down = density.log_volume
    return inner_estimate._replace(
        log_mean=inner_estimate.log_mean - down, debiased=inner_estimate.debiased - down
    )


@protocol.cdf.register
def _(density: AffineDensity, value: Tensor) -> Tensor | None:
    return protocol.cdf(density.density, density.inner(value))


@protocol.normals.register
def _(density: AffineDensity) -> protocol.Normals | None:
    inner_normals = protocol.normals(density.density)
    if inner_normals is None:
        return None
    location, scale = density.location.double(), density.scale.double()
    return protocol.Normals(
        inner_normals.log_weights, location + scale * inner_normals.mean, scale * inner_normals.scale
    )


@protocol.mahalanobis.register
def _(density: AffineDensity, value: Tensor) -> Tensor | None:
    return protocol.mahalanobis(density.density, density.inner(value))


@protocol.quadratic_bound.register
def _(density: AffineDensity, value: Tensor) -> protocol.QuadraticBound | None:
    inner_bound = protocol.quadratic_bound(density.density, density.inner(value))
    if inner_bound is None:
        return None
    pull, stiffness = inner_bound.pull / density.scale, inner_bound.stiffness / density.scale.square()
    return protocol.QuadraticBound(inner_bound.log_prob - density.log_volume, pull, stiffness)


@protocol.images.register
def _(density: AffineDensity, channels: Collection[str]) -> dict[str, Tensor]:
    return protocol.images(
        density.density, channels
    )  # the transform changes numbers, not what an image shows


@protocol.mode_candidates.register
def _(density: AffineDensity) -> Tensor:
    return density.outer(protocol.mode_candidates(density.density))


@protocol.peak_widths.register
def _(density: AffineDensity) -> Tensor:
    return protocol.peak_widths(density.density) * density.scale[..., 0]


class AffineSet(protocol.ValueSet):
    """Prediction set for X = location + scale · Y: the prediction set for Y, transformed in the same way.

    Args:
        inner: prediction set for Y.
        density: density of X, which holds the location and the scale.
    """

    def __init__(self, inner: protocol.ValueSet, density: AffineDensity) -> None:
        self.inner = inner
        self.density = density
        self.stated_probability = inner.stated_probability

    def contains(self, value: Tensor) -> Tensor:
        return self.inner.contains(self.density.inner(value))

    def size(self) -> Tensor:
        return self.inner.size() * self.density.scale.double().prod(-1)

    def empty(self) -> Tensor:
        return self.inner.empty()

    def parts(self) -> list[list[int]] | list[list[tuple[float, float]]] | None:
        inner_parts = self.inner.parts()
        if inner_parts is None:
            return None
        location, scale = (
            number.double().flatten().tolist() for number in (self.density.location, self.density.scale)
        )
        frames = zip(inner_parts, location, scale, strict=True)
        return [[(at + by * part[0], at + by * part[1]) for part in parts] for parts, at, by in frames]  # type: ignore[index]


@protocol.value_set.register
def _(density: AffineDensity) -> AffineSet | None:
    inner_set = protocol.value_set(density.density)
    return None if inner_set is None else AffineSet(inner_set, density)
