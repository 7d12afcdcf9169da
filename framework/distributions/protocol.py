"""The functions that are defined for every density, with the shapes and units of their results.

A density is a `torch.distributions.Distribution`. torch defines its `log_prob` (nats), `sample`, `entropy` (nats),
`mode`, `support` and, for classes, `enumerate_support`. This module defines further functions. Each of them dispatches
on the type of the density, so that the author of a density registers what is known for this type:

    @marginal.register
    def _(density: Mine, index: int) -> Mine: ...

**No default claims to be exact.** A default that cannot know the result returns draws, an error of NaN or None ("not
known in closed form; use draws"), or raises a `UserError` that says what to register. A subclass inherits the functions
that are registered for its base. The structures call the function for each of their parts: `density.Mixture`,
`batch_shapes.Stacked`, `batch_shapes.Reshaped`, `tempering.CircularPower`. Those of torch's densities are registered in
`closed_forms`.

Three further quantities are computed from these functions, with nothing to register: `class_probabilities`,
`circular_moments` (which says where its grid resolved the density) and `density.circular_grid`.

In shapes, `*batch` is the batch_shape, `*event` the event_shape, and `*sample` any dimensions before them.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection
from functools import singledispatch
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular, circular_median
from framework.errors import UserError


@singledispatch
def marginal(density: Distribution, index: int) -> Distribution:
    """Return the density of number `index` of the target alone, with an event dimension of one, (1,).

    Default: a density of one number is its own marginal. Densities over several numbers register their own.

    Raises:
        UserError: the density has not registered a marginal.
    """
    if density.event_shape == (1,) and index == 0:
        return density
    raise UserError(
        f"{type(density).__name__} has no marginal for one of its {tuple(density.event_shape)} numbers. "
        "Register one with `framework.distributions.protocol.marginal.register`, or leave out the "
        "metric or figure that needs it."
    )


@singledispatch
def median(density: Distribution, samples: int) -> Tensor:
    """Return the point of least expected absolute deviation, number by number (thesis eq. 3.23), (*batch, *event).

    Default: for classes the mode, since a label is right or wrong and nothing lies between; otherwise the median of
    `samples` draws (eq. 3.24), for angles on the circle. A density that knows the median in closed form registers it
    and draws nothing. A mixture of several components over an image returns the mean instead.
    """
    if density.has_enumerate_support:
        return density.mode
    draws = density.sample(torch.Size((samples,)))
    if isinstance(density.support, Circular):
        return circular_median(draws)
    return draws.median(0).values


@singledispatch
def pick(density: Distribution, index: Tensor) -> Distribution:
    """Return the density at `index` of the last batch dimension of a density with batch_shape (*batch, K).

    `index` has the shape (*sample, *batch). Only `sample` of the returned density is used. Default: all K densities are
    sampled and all draws but one are discarded, which is right but slow; a density with parameters registers a function
    that gathers them (`take`).
    """
    return _Picked(density, index)


def take(parameter: Tensor, index: Tensor) -> Tensor:
    """Return `parameter` (*batch, K, number) at `index` (*sample, *batch) of K: (*sample, *batch, number)."""
    lead = index.shape[: index.dim() - parameter.dim() + 2]
    wide = parameter.expand((*lead, *parameter.shape))
    return wide.gather(-2, index[..., None, None].expand(*index.shape, 1, parameter.shape[-1])).squeeze(-2)


class _Picked(Distribution):
    """One chosen component for each item; all components are sampled, and the draws of the others are discarded."""

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

    X has the density at `index` of the batch. Only `log_prob` of the returned density is used. Default: values are
    rounded where the origin is added. A density with a location registers a function that subtracts the origin from the
    location: then no rounding limits how narrow the density may be.

    Args:
        density: density of one number, event_shape (1,).
        index: int64, one for each batch dimension; broadcast together they have the shape (*items).
        origin: (*items, 1).
    """
    return _Recentred(density, index, origin)


class _Recentred(Distribution):
    """Recentred items of a batch, each used any number of times.

    The whole batch is evaluated as often as the most frequent item occurs.
    """

    arg_constraints = {}  # noqa: RUF012  # pyright: ignore[reportAssignmentType]

    def __init__(self, density: Distribution, index: tuple[Tensor, ...], origin: Tensor) -> None:
        self.density = density
        self.origin = origin
        self.like = density.sample(torch.Size((0,)))
        shape = torch.broadcast_shapes(origin.shape[:-1], *(part.shape for part in index))
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
    """Return the density proportional to p^(1/T), T > 0 a scalar; same shapes and number type, differentiable in T.

    Call `tempering.temper` instead, which refuses an invalid T. Default (registered in `tempering`): classes are
    enumerated, and the density of one angle over the whole turn is normalised on a grid that is refined until it
    resolves the power.

    Raises:
        UserError: any other density that has not registered its power, or a power too narrow for the finest grid.
    """
    raise TypeError(f"{type(density).__name__} is no torch.distributions.Distribution.")


class Estimate(NamedTuple):
    """A log-density and its Monte Carlo error; all fields have the same shape and are in nats unless stated otherwise.

    Attributes:
        log_mean: the value of log_prob; its expectation is below the truth by about standard_error²/2 (Jensen).
        debiased: log_mean + standard_error²/2.
        standard_error: standard error of log_mean, from random draws inside the density; 0 where nothing is drawn, NaN
            where it is not known, infinite where no draw had any weight.
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
    """Return an estimate whose `debiased` follows from its error; -∞ with an infinite error stays -∞."""
    correction = torch.where(standard_error == math.inf, 0.0, standard_error.square() / 2)
    return Estimate(log_mean, log_mean + correction, standard_error, samples, unresolved)


@singledispatch
def estimate(density: Distribution, value: Tensor) -> Estimate:
    """Return the log-density at `value` (*sample, *batch, *event) with its Monte Carlo error, (*sample, *batch).

    Default: log_prob with an error of NaN, "not known", since it is not known whether log_prob draws. A density whose
    log_prob is computed without drawing registers `exact_estimate`; one that draws registers its own function.
    """
    result = exact_estimate(density, value)
    unknown = torch.full_like(result.log_mean, math.nan)
    return estimate_with_error(result.log_mean, unknown, result.samples, result.unresolved)


def exact_estimate(density: Distribution, value: Tensor) -> Estimate:
    """Return the estimate of a density whose log_prob draws nothing: `estimate.register(Mine, exact_estimate)`."""
    log_prob = density.log_prob(value)
    samples = torch.zeros(log_prob.shape, dtype=torch.int64, device=log_prob.device)
    return Estimate(log_prob, log_prob, torch.zeros_like(log_prob), samples, samples > 0)


@singledispatch
def cdf(density: Distribution, value: Tensor) -> Tensor | None:
    """Return P(X ≤ y) of a density of one real, float64 (*sample, *batch), at `value` (*sample, *batch, 1).

    Default: exact where `normals` knows the density as a mixture of normals, otherwise None, "not known".
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
    """Return P(X_i ≤ y_i) of each number i on its own; float64, in the shape of `value` (*sample, *batch, *event).

    Default: for a vector of reals `cdf` of each `marginal`, or None where a `cdf` is not known; for an image None. A
    density over images registers its own function, since a hundred thousand marginals would be too many.
    """
    if len(density.event_shape) != 1:
        return None
    indices = range(density.event_shape[0])
    parts = [cdf(marginal(density, index), value[..., index : index + 1]) for index in indices]
    known = [part for part in parts if part is not None]
    return torch.stack(known, -1) if len(known) == len(parts) else None


@singledispatch
def arc_probability(density: Distribution, start: Tensor, end: Tensor) -> Tensor | None:
    """Return the probability of the arc from `start` counter-clockwise to `end` for one angle; None if unknown.

    Angles are (*sample, *batch, 1), radians; the result is float64 (*sample, *batch). The arc is shorter than the whole
    circle, and empty between equal ends. Default: None; `circular_moments` then gives the probability where the density
    is not too narrow.
    """
    return None


def arc_length(start: Tensor, end: Tensor) -> Tensor:
    """Return the angle from `start` counter-clockwise to `end`, radians in [0, 2π], float64."""
    return torch.remainder(end.double() - start.double(), 2 * math.pi)


class Normals(NamedTuple):
    """A mixture of normals over one real: log-weights, means and standard deviations, (*batch, component), float64."""

    log_weights: Tensor
    mean: Tensor
    scale: Tensor


def one_normal(mean: Tensor, scale: Tensor) -> Normals:
    """Return the result of `normals` for a single normal density; mean and scale have the shape (*batch, 1)."""
    mean = mean.double()
    return Normals(torch.zeros_like(mean), mean, scale.double())


@singledispatch
def normals(density: Distribution) -> Normals | None:
    """Return the normals of which a density of one real, event_shape (1,), is a mixture.

    Default: None, not known.
    """
    return None


@singledispatch
def mahalanobis(density: Distribution, value: Tensor) -> Tensor | None:
    """Return (y - μ)ᵀ Σ⁻¹ (y - μ) of a normal density over any number of reals, float64 (*sample, *batch).

    Default: None, the density is not known to be normal.
    """
    return None


@singledispatch
def mode_candidates(density: Distribution) -> Tensor:
    """Return candidates for the mode, (peak, *batch, *event): values where the density may be highest, unchecked.

    Default: the mode alone. A density with several peaks registers a candidate for each.
    """
    return density.mode.unsqueeze(0)


@singledispatch
def peak_widths(density: Distribution) -> Tensor:
    """Return the width of each of the `mode_candidates` of a density of one number, (peak, *batch), in its unit.

    Default: the standard deviation of the normal density with the same height.
    """
    candidates = mode_candidates(density)
    return (-density.log_prob(candidates).double()).exp() / math.sqrt(2 * math.pi)


class QuadraticBound(NamedTuple):
    """A lower bound of log p that touches it (see `quadratic_bound`): log_prob, its gradient `pull`, and `stiffness`.

    log_prob is (*sample, *batch); `pull` and `stiffness` are (*sample, *batch, *event).
    """

    log_prob: Tensor
    pull: Tensor
    stiffness: Tensor


@singledispatch
def quadratic_bound(density: Distribution, value: Tensor) -> QuadraticBound | None:
    """Return a lower bound of log p that touches it at `value` y (*sample, *batch, *event); by default None, not known.

    With pull g and stiffness h, the bound for reals is log p(y + d) ≥ log p(y) + Σ (g d - h d²/2), h > 0, and for
    angles log p(y + d) ≥ log p(y) + Σ (g sin d - h (1 - cos d)), for all d. A mixture has as g and h the means over its
    components, weighted by each component's share of p(y) (Jensen), so a step to the bound's maximum never lowers p
    (Dempster, Laird & Rubin 1977).
    """
    return None


@singledispatch
def images(density: Distribution, channels: Collection[str]) -> dict[str, Tensor]:
    """Return images of the density's point prediction, with exactly the requested channels.

    Each is (*batch, height, width) or (*batch, height, width, number), as `framework.renderer.Renderer.channels` says:
    "color" is linear RGB. For torch's own densities over images, event_shape (height, width, number), "color" is the
    mean, taken as linear RGB; a density over the numbers of files (a target of kind "image") registers its own
    function. Default: the density has no images.

    Raises:
        UserError: no images are registered for the density, or one of the channels is not among them.
    """
    raise UserError(
        f"{type(density).__name__} of event_shape {tuple(density.event_shape)} provides no "
        f"{', '.join(sorted(channels))}. Register its images with `framework.distributions.protocol.images.register`, "
        "or leave out the metric or figure that needs them."
    )


class ValueSet(ABC):
    """A set of values for each item of the batch that is stated to contain the target.

    Attributes:
        stated_probability: least share of targets that the sets are stated to contain; None if not stated.
    """

    stated_probability: float | None = None

    @abstractmethod
    def contains(self, value: Tensor) -> Tensor:
        """Return true for each value (*sample, *batch, *event) in the set of its item, bool (*sample, *batch)."""

    @abstractmethod
    def size(self) -> Tensor:
        """Return the size of each set, float64 (*batch).

        The size is a number of labels, radians of one angle, the length for one real, or the volume for several.
        """

    @abstractmethod
    def empty(self) -> Tensor:
        """Return true for each empty set, bool (*batch)."""

    def parts(self) -> "list[list[int]] | list[list[tuple[float, float]]] | None":
        """Return the parts of the set of each item of the flattened batch, ascending.

        The parts are labels of classes, (low, high) of one real, or (low, high) of one angle in radians, from low in
        [-π, π) counter-clockwise to high, at most one turn further. Default: None, the set cannot be listed.
        Predictions print the listed parts.
        """
        return None


@singledispatch
def value_set(density: Distribution) -> ValueSet | None:
    """Return the prediction sets of the items of the density.

    Default: None, there are no sets. Structures return None too: a guarantee for a density does not hold for a mixture,
    a power or a marginal of it. An affine transform (`affine.AffineDensity`) has the transformed sets.
    """
    return None
