"""The functions that are defined for every density, with the shapes and units of their results.

A density is a `torch.distributions.Distribution`. torch defines its `log_prob` (nats), `sample`, `entropy` (nats),
`mode`, `support` and, for classes, `enumerate_support`. This module defines further functions. Each of them dispatches
on the type of the density, so that the author of a density registers what is known for this type:

    @marginal.register
    def _(density: Mine, index: int) -> Mine: ...

**No default claims to be exact.** A default that cannot compute a quantity exactly returns draws, an error of NaN, or
None ("not known in closed form; use draws"). Or it raises a `UserError` that says what to register. A subclass inherits
the functions that are registered for its base. Densities that are made of other densities (`density.Mixture`,
`batch_shapes.Stacked`, `batch_shapes.Reshaped`, `tempering.CircularPower`) call the function for each of these. The
functions for torch's own densities are registered in `closed_forms`.

Three further quantities are computed from these functions and need no registration: `class_probabilities`,
`circular_moments` (which says where its grid resolved the density) and `density.circular_grid`.

In shapes, `*batch` is the batch_shape, `*event` the event_shape, and `*sample` any dimensions before them.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from functools import singledispatch
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular, circular_median
from framework.distributions.shapes import broadcast_shapes
from framework.errors import UserError


@singledispatch
def marginal(density: Distribution, index: int) -> Distribution:
    """Return the density of number `index` of the target alone, with an event dimension of one, (1,).

    By default, a density of one number is its own marginal. A density over several numbers registers its own function.

    Raises:
        UserError: the density has not registered a marginal.
    """
    if density.event_shape == (1,) and index == 0:
        return density
    raise UserError(
        f"{type(density).__name__} describes a target of shape {tuple(density.event_shape)} and has no marginal for "
        "one number of it. Register one with `framework.distributions.protocol.marginal.register`, or leave out the "
        "metric or figure that needs it."
    )


@singledispatch
def median(density: Distribution, samples: int) -> Tensor:
    """Return the point of least expected absolute deviation, number by number (thesis eq. 3.23), (*batch, *event).

    For classes, the default returns the mode, since a label is either right or wrong. For numbers, the default returns
    the median of `samples` draws (thesis eq. 3.24, `even_sample`), which for angles is the circular median. A density
    whose median is known in closed form registers its own function, which draws nothing. For a mixture of several
    components over images, the function returns the mean instead.
    """
    if density.has_enumerate_support:
        return density.mode
    draws = even_sample(density, samples)
    return circular_median(draws) if isinstance(density.support, Circular) else draws.median(0).values


@singledispatch
def even_sample(density: Distribution, count: int) -> Tensor:
    """Return `count` draws, (count, *batch, *event), for shares of draws, and for means over them, such as the median.

    The default returns independent draws. A density may register a function whose draws together are spread more
    evenly: shares and means have the same expectations as those of independent draws, and vary less. So chance does not
    decide which of two opposite peaks of nearly equal probability holds the median of an angle.
    """
    return density.sample(torch.Size((count,)))


@singledispatch
def pick(density: Distribution, index: Tensor) -> Distribution:
    """Return the density at `index` of the last batch dimension of a density with batch_shape (*batch, K).

    `index` has the shape (*sample, *batch). Only `sample` of the returned density is used. By default, all K densities
    are sampled, and all draws except those at `index` are discarded, which is right but slow. A density with parameters
    registers a function that reads the parameters at `index` (`take`).
    """
    return _Picked(density, index)


def take(parameter: Tensor, index: Tensor) -> Tensor:
    """Return the entries of `parameter` at `index` of its dimension K, (*sample, *batch, number).

    Args:
        parameter: (*batch, K, number).
        index: from 0 to K - 1, (*sample, *batch).
    """
    lead = index.shape[: index.dim() - parameter.dim() + 2]
    wide = parameter.expand((*lead, *parameter.shape))
    return wide.gather(-2, index[..., None, None].expand(*index.shape, 1, parameter.shape[-1])).squeeze(-2)


class _Picked(Distribution):
    """The default result of `pick`, which samples all K densities and discards the draws that are not at `index`."""

    arg_constraints = {}  # noqa: RUF012  # pyright: ignore[reportAssignmentType]

    def __init__(self, density: Distribution, index: Tensor) -> None:
        self.density = density
        self.index = index
        super().__init__(index.shape, density.event_shape, validate_args=False)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        lead = self.index.shape[: self.index.dim() - len(self.density.batch_shape) + 1]
        samples = self.density.sample(torch.Size(sample_shape) + lead)  # (*sample, *lead, *batch, K, *event)
        index = self.index.expand((*sample_shape, *self.index.shape))
        axis = index.dim()
        index = index.reshape(*index.shape, 1, *(1,) * len(self.event_shape))
        return samples.gather(axis, index.expand((*index.shape[: axis + 1], *self.event_shape))).squeeze(axis)


@singledispatch
def recentre(density: Distribution, index: tuple[Tensor, ...], origin: Tensor) -> Distribution:
    """Return the density of X - origin, in float64, so that values near the origin keep their digits.

    X is a random number with the density at `index` of the batch. Only `log_prob` of the returned density is used. By
    default, the origin is added to each value, and the sum is rounded to the density's number type. A density with a
    location registers a function that subtracts the origin from the location: then no rounding limits how narrow the
    density may be.

    Args:
        density: density of one number, event_shape (1,).
        index: indices of the items, int64, one tensor for each batch dimension; broadcast together they have the shape
            (*items).
        origin: value that is subtracted, (*items, 1).
    """
    return _Recentred(density, index, origin)


class _Recentred(Distribution):
    """The default result of `recentre`: items of a batch, each of which may be used any number of times.

    For one log_prob, the whole batch is evaluated as often as the most frequent item occurs in `index`.
    """

    arg_constraints = {}  # noqa: RUF012  # pyright: ignore[reportAssignmentType]

    def __init__(self, density: Distribution, index: tuple[Tensor, ...], origin: Tensor) -> None:
        self.density = density
        self.origin = origin
        self.like = density.sample(torch.Size((0,)))
        shape = broadcast_shapes(origin.shape[:-1], *(part.shape for part in index))
        flat = torch.zeros(shape, dtype=torch.int64, device=origin.device)
        for part, size in zip(index, density.batch_shape, strict=True):
            flat = flat * size + part
        self.item = flat.flatten()
        order = self.item.argsort(stable=True)
        count = torch.bincount(self.item, minlength=density.batch_shape.numel())
        first = (count.cumsum(0) - count)[self.item[order]]
        self.repetition = torch.empty_like(order)
        self.repetition[order] = torch.arange(len(order), device=order.device) - first
        super().__init__(shape, density.event_shape, validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        value = (value + self.origin).to(self.like.dtype)
        lead = value.shape[: value.dim() - len(self.batch_shape) - 1]
        value = value.expand(*lead, *self.batch_shape, 1).reshape(*lead, -1, 1)
        repetitions = int(self.repetition.amax()) + 1
        whole = value.new_zeros(*lead, repetitions, self.density.batch_shape.numel(), 1)
        whole[..., self.repetition, self.item, :] = value
        log_prob = self.density.log_prob(whole.reshape(*lead, repetitions, *self.density.batch_shape, 1))
        log_prob = log_prob.reshape(*lead, repetitions, -1)[..., self.repetition, self.item]
        return log_prob.reshape(*lead, *self.batch_shape)


@singledispatch
def tempered_density(density: Distribution, temperature: Tensor) -> Distribution:
    """Return the density proportional to p^(1/T) for a density p and a temperature T > 0, a scalar.

    The result has the same shapes and number type as p, and is differentiable in T. Callers use `tempering.temper`
    instead, which refuses an invalid T and then calls this function. The default, registered in `tempering`, handles
    two kinds of densities. The probabilities of classes are raised to the power and divided by their sum. The power of
    the density of one angle over the whole circle is normalised on a grid, which is refined until it resolves the
    power.

    Raises:
        UserError: any other density that has not registered its power, or a power too narrow for the finest grid.
    """
    raise TypeError(
        f"Got an object of type {type(density).__name__}; expected a torch.distributions.Distribution. Return such a "
        "density from the density head."
    )


class Estimate(NamedTuple):
    """A log-density and its Monte Carlo error; all fields have the same shape and are in nats unless stated otherwise.

    Attributes:
        log_mean: the value of log_prob; its expectation is about standard_error²/2 below the exact log-density
            (Jensen).
        debiased: log_mean + standard_error²/2.
        standard_error: standard error of log_mean, from random draws inside the density; 0 where nothing is drawn, NaN
            where it is not known, infinite where all draws had weight 0.
        samples: number of draws, int64; 0 where nothing is drawn or the number is not known.
        unresolved: bool, true where a requested tolerance was not reached.
    """

    log_mean: Tensor
    debiased: Tensor
    standard_error: Tensor
    samples: Tensor
    unresolved: Tensor

    def map_fields(self, change: Callable[[Tensor], Tensor]) -> "Estimate":
        """Return an estimate with `change` applied to each of the five fields."""
        return Estimate(*map(change, self))


def estimate_with_error(
    log_mean: Tensor, standard_error: Tensor, samples: Tensor, unresolved: Tensor
) -> Estimate:
    """Return an estimate with `debiased` computed from the error, or equal to `log_mean` if the error is infinite."""
    correction = torch.where(standard_error == math.inf, 0.0, standard_error.square() / 2)
    return Estimate(log_mean, log_mean + correction, standard_error, samples, unresolved)


@singledispatch
def estimate(density: Distribution, value: Tensor) -> Estimate:
    """Return the log-density at `value` (*sample, *batch, *event) with its Monte Carlo error, (*sample, *batch).

    The default returns log_prob with an error of NaN ("not known"), since it is not known whether log_prob uses random
    draws. A density whose log_prob uses no draws registers `exact_estimate`. A density whose log_prob uses draws
    registers its own function.
    """
    result = exact_estimate(density, value)
    unknown = torch.full_like(result.log_mean, math.nan)
    return estimate_with_error(result.log_mean, unknown, result.samples, result.unresolved)


def exact_estimate(density: Distribution, value: Tensor) -> Estimate:
    """Return the log-density at `value` as an estimate without error, for a density whose log_prob uses no draws.

    Such a density `Mine` registers this function by `estimate.register(Mine, exact_estimate)`.
    """
    log_prob = density.log_prob(value)
    samples = torch.zeros(log_prob.shape, dtype=torch.int64, device=log_prob.device)
    return Estimate(log_prob, log_prob, torch.zeros_like(log_prob), samples, samples > 0)


@singledispatch
def cdf(density: Distribution, value: Tensor) -> Tensor | None:
    """Return P(X ≤ y) of a density of one real number, float64 (*sample, *batch), at `value` y (*sample, *batch, 1).

    The default is exact if `normals` knows the density as a mixture of normals. For other densities, it returns None
    ("not known").
    """
    components = normals(density)
    if components is None:
        return None
    residual = value.double() - components.mean
    # a point mass counts half at its position
    standard = torch.where(residual == 0, residual, residual / components.scale)
    weights = components.log_weights.exp()
    below = torch.where(weights > 0, weights * torch.special.ndtr(standard), 0.0)
    return below.sum(-1).clamp(max=1)


@singledispatch
def marginal_cdfs(density: Distribution, value: Tensor) -> Tensor | None:
    """Return P(X_i ≤ y_i) of each number i on its own; float64, in the shape of `value` y (*sample, *batch, *event).

    For a vector of real numbers, the default returns the `cdf` of each `marginal`, or None if one of these functions is
    not known. For an image, it returns None. A density over images registers its own function, since a hundred thousand
    marginals would be too many.
    """
    if len(density.event_shape) != 1:
        return None
    indices = range(density.event_shape[0])
    parts = [cdf(marginal(density, index), value[..., index : index + 1]) for index in indices]
    known = [part for part in parts if part is not None]
    return torch.stack(known, -1) if len(known) == len(parts) else None


@singledispatch
def ranked_score(density: Distribution, value: Tensor) -> Tensor | None:
    """Return the continuous ranked probability score of a density of one real number at `value` y (*batch, 1).

    The score E|X - y| - ½ E|X - X'| (Gneiting & Raftery 2007, eq. 21) is float64, (*batch), in the unit of the number.
    The default returns None, because no formula is known. The metric `crps` then uses a formula of its own or draws.
    """
    return None


@singledispatch
def arc_probability(density: Distribution, start: Tensor, end: Tensor) -> Tensor | None:
    """Return the probability of the arc from `start` counter-clockwise to `end` for one angle; None if unknown.

    Angles are (*sample, *batch, 1), radians; the probability is float64 (*sample, *batch). The arc is shorter than the
    whole circle, and it is empty if `start` equals `end`. The default returns None. Callers then use
    `circular_moments`, which gives the probability unless the density is too narrow for its grid.
    """
    return None


@singledispatch
def trigonometric_moments(density: Distribution, count: int, weights: Tensor | None = None) -> Tensor | None:
    """Return the moments E exp(i n X) of one angle X, n = 0 … `count` - 1; None if they are not known.

    The moments are complex128, (count, *batch). With `weights` (*batch, float64) the result is their weighted sum over
    the last dimension of the batch, so that a mixture of many components needs memory for one order only. The default
    returns None. Callers then use `circular_moments`, which computes the moments on a grid.
    """
    return None


def weighted_moments(moments: Tensor | None, weights: Tensor | None) -> Tensor | None:
    """Return the sum of moments (count, *batch, K) over K with `weights` (*batch, K).

    If one of the arguments is None, `moments` is returned.
    """
    return moments if moments is None or weights is None else (weights * moments).sum(-1)


def arc_length(start: Tensor, end: Tensor) -> Tensor:
    """Return the angle from `start` counter-clockwise to `end`, radians in [0, 2π], float64."""
    return torch.remainder(end.double() - start.double(), 2 * math.pi)


class Region(NamedTuple):
    """Probabilities and size of highest-density regions of each item, (*batch,), float64.

    A highest-density region holds all values at which the density is above some level.

    Attributes:
        low: probability of all values at which the density is higher than at the argument `value` of `highest_region`.
        high: probability of all values at which the density is at least as high as at `value`.
        size: size of the region with the probability `mass`, an argument of `highest_region`, in the target's unit.
    """

    low: Tensor
    high: Tensor
    size: Tensor


@singledispatch
def highest_region(
    density: Distribution, value: Tensor, mass: float, equal: Mapping[torch.dtype, float]
) -> Region | None:
    """Return highest-density regions of a density of one number; None if no closed form is known (the default).

    Args:
        density: a density of one number, with batch_shape (*batch).
        value: value with whose density the density of all other values is compared (`Region`), (*batch, 1).
        mass: probability of the region whose size is returned, in (0, 1).
        equal: for each dtype of the density (float32, float64), the relative difference up to which two densities
            count as equal, so that rounding has no influence.
    """
    return None


class Normals(NamedTuple):
    """A mixture of normals over one real number.

    Attributes:
        log_weights: logarithms of the weights, (*batch, component), float64.
        mean: means of the normals, (*batch, component), float64.
        scale: standard deviations of the normals, (*batch, component), float64.
    """

    log_weights: Tensor
    mean: Tensor
    scale: Tensor


def one_normal(mean: Tensor, scale: Tensor) -> Normals:
    """Return a single normal density as `Normals`; mean and standard deviation have the shape (*batch, 1)."""
    mean = mean.double()
    return Normals(torch.zeros_like(mean), mean, scale.double())


@singledispatch
def normals(density: Distribution) -> Normals | None:
    """Return the mixture of normals that a density of one real number, event_shape (1,), is equal to.

    The default returns None, because the density is not known to be a mixture of normals.
    """
    return None


@singledispatch
def mahalanobis(density: Distribution, value: Tensor) -> Tensor | None:
    """Return (y - μ)ᵀ Σ⁻¹ (y - μ) at `value` y for a normal density with mean μ and covariance Σ.

    The density may be over any number of real numbers. The squared distance is float64, (*sample, *batch). The default
    returns None, because the density is not known to be normal.
    """
    return None


@singledispatch
def mode_candidates(density: Distribution) -> Tensor:
    """Return candidates for the mode, (peak, *batch, *event): values where the density may be highest.

    The density need not be highest at one of the candidates. The default returns the mode alone. A density with several
    peaks registers a function that returns a candidate for each peak.
    """
    return density.mode.unsqueeze(0)


@singledispatch
def peak_widths(density: Distribution) -> Tensor:
    """Return the width of the peak at each of the `mode_candidates` of a density of one number, (peak, *batch).

    The unit is that of the number. The default returns the standard deviation of a normal density that is as high at
    its mode as the density is at the candidate.
    """
    candidates = mode_candidates(density)
    return (-density.log_prob(candidates).double()).exp() / math.sqrt(2 * math.pi)


class QuadraticBound(NamedTuple):
    """A lower bound of log p that touches log p at a value y, as `quadratic_bound` returns it.

    With g = `pull` and h = `stiffness`, the bound at y + d is log p(y) + Σ (g d - h d²/2) for real numbers, and
    log p(y) + Σ (g sin d - h (1 - cos d)) for angles. The sums are over the numbers of an event.

    Attributes:
        log_prob: log p(y), (*sample, *batch), nats.
        pull: gradient of log p at y, (*sample, *batch, *event).
        stiffness: minus the second derivative of the bound by each number at y, above 0, (*sample, *batch, *event).
    """

    log_prob: Tensor
    pull: Tensor
    stiffness: Tensor


@singledispatch
def quadratic_bound(density: Distribution, value: Tensor) -> QuadraticBound | None:
    """Return a lower bound of log p that touches log p at `value` y (*sample, *batch, *event).

    Let g be the `pull` and h the `stiffness` of the bound, h > 0. For real numbers, log p(y + d) ≥ log p(y) + Σ (g d -
    h d²/2) for all d. For angles, log p(y + d) ≥ log p(y) + Σ (g sin d - h (1 - cos d)) for all d. In a mixture, g and
    h are means over the components, weighted by each component's share of p(y) (Jensen). So a step to the maximum of
    the bound never lowers p (Dempster, Laird & Rubin 1977). The default returns None, because no bound is known.
    """
    return None


@singledispatch
def images(density: Distribution, channels: Collection[str]) -> dict[str, Tensor]:
    """Return images of the density's point prediction, with exactly the requested channels.

    Each image is (*batch, height, width) or (*batch, height, width, number), as `framework.renderer.Renderer.channels`
    says: "color" is linear RGB. For torch's own densities over images, event_shape (height, width, number), "color" is
    the mean, taken as linear RGB. If a density is over pixel values as they are stored in files (a target of kind
    "image"), it registers its own function. By default, a density has no images, and an error is raised.

    Raises:
        UserError: no images are registered for the density, or one of the channels is not among them.
    """
    raise UserError(
        f"{type(density).__name__} of event_shape {tuple(density.event_shape)} provides no "
        f"{', '.join(sorted(channels))}. Register its images with `framework.distributions.protocol.images.register`, "
        "or leave out the metric or figure that needs them."
    )


class ValueSet(ABC):
    """Prediction sets: for each item of a batch, a set of values that is stated to contain the target.

    Attributes:
        stated_probability: least share of targets that the sets are stated to contain; None if not stated.
    """

    stated_probability: float | None = None

    @abstractmethod
    def contains(self, value: Tensor) -> Tensor:
        """Return a mask, bool (*sample, *batch): true if a value (*sample, *batch, *event) is in its item's set."""

    @abstractmethod
    def size(self) -> Tensor:
        """Return the size of each set, float64 (*batch).

        The size is the number of labels for classes, the length in radians for one angle, the length for one real
        number, or the volume for several real numbers.
        """

    @abstractmethod
    def empty(self) -> Tensor:
        """Return a mask, bool (*batch): true if the set of the item is empty."""

    def parts(self) -> "list[list[int]] | list[list[tuple[float, float]]] | None":
        """Return the elements or intervals of which each set consists, ascending; one list for each item of the batch.

        The batch is flattened. For classes, the parts are labels. For one real number, they are intervals (low, high).
        For one angle, they are arcs (low, high) in radians, from low in [-π, π) counter-clockwise to high, at most one
        turn further. `mode=predict` writes the parts. The default returns None, because the set cannot be listed.
        """
        return None


@singledispatch
def value_set(density: Distribution) -> ValueSet | None:
    """Return the prediction sets of a density, one for each item of its batch; None if it has none.

    By default, a density that is a `ValueSet` is returned itself, and other densities have none. A mixture, a power or
    a marginal of a density with sets has no sets, since a guarantee for this density does not hold for the changed one.
    An affine transform (`affine.AffineDensity`) has the transformed sets.
    """
    return density if isinstance(density, ValueSet) else None
