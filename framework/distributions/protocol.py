"""Everything that a density may be asked: each question, the shapes and units of its answer, and what an answer claims.

A density is a `torch.distributions.Distribution`. torch's own questions are `log_prob` (nats), `sample`, `entropy`
(nats), `mode`, `support` and, of classes, `enumerate_support`. The further ones stand here. Each is a function that
dispatches on the type of density, so that whoever writes a density registers what it knows:

    @marginal.register
    def _(density: Mine, index: int) -> Mine: ...

**No default claims to be exact.** One that cannot know answers with draws, with an error of NaN, with None ("not known
in closed form; draws have to say") or with a `UserError` that says what to register. A subclass inherits the claims of
its base. The structures forward every question to what they are made of: `density.Mixture`, `batch_shapes.Stacked`,
`batch_shapes.Reshaped`, `tempering.CircularPower`. What torch's densities know is in `closed_forms`.

Three further questions are computed from the answers above, with nothing to register: `class_probabilities`,
`circular_moments` (says where its grid resolved the density) and `density.circular_grid`.

In shapes `*batch` is the batch_shape, `*event` the event_shape, and `*sample` any dimensions before them.
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
    """The density of number `index` of the target alone; keeps an event dimension of one, (1,).

    Default: a density of one number is its own marginal. Densities over several numbers register theirs.

    Raises:
        UserError: the density has not said how.
    """
    if density.event_shape == (1,) and index == 0:
        return density
    raise UserError(
        f"{type(density).__name__} has no marginal for one of its {tuple(density.event_shape)} numbers. "
        "Register one with `framework.distributions.protocol.marginal.register`, or leave out the "
        "metric or picture that needs it."
    )


@singledispatch
def median(density: Distribution, samples: int) -> Tensor:
    """The point of least expected absolute deviation, number by number (thesis eq. 3.23), (*batch, *event).

    Default: of classes the mode, since a label is right or wrong and nothing lies between; otherwise the median of
    `samples` draws (eq. 3.24), of angles on the circle. Who knows it in closed form registers it and draws nothing. Of
    several components over an image the mean stands for it.
    """
    if density.has_enumerate_support:
        return density.mode
    drawn = density.sample(torch.Size((samples,)))
    if isinstance(density.support, Circular):
        return circular_median(drawn)
    return drawn.median(0).values


@singledispatch
def pick(density: Distribution, index: Tensor) -> Distribution:
    """Of a density with batch_shape (*batch, K) the one at `index` (*sample, *batch) of the last batch dimension.

    Only `sample` is asked of the answer. Default: everything is drawn and all but one of K draws thrown away, which is
    right but slow; a density with parameters registers one that gathers them (`take`).
    """
    return _Picked(density, index)


def take(parameter: Tensor, index: Tensor) -> Tensor:
    """`parameter` (*batch, K, number) at `index` (*sample, *batch) of K: (*sample, *batch, number)."""
    lead = index.shape[: index.dim() - parameter.dim() + 2]
    wide = parameter.expand((*lead, *parameter.shape))
    return wide.gather(-2, index[..., None, None].expand(*index.shape, 1, parameter.shape[-1])).squeeze(-2)


class _Picked(Distribution):
    """Samples of one component each, by drawing all."""

    arg_constraints = {}  # noqa: RUF012  # pyright: ignore[reportAssignmentType]

    def __init__(self, density: Distribution, index: Tensor) -> None:
        self.density = density
        self.index = index
        super().__init__(index.shape, density.event_shape, validate_args=False)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        lead = self.index.shape[: self.index.dim() - len(self.density.batch_shape) + 1]
        drawn = self.density.sample(torch.Size(sample_shape) + lead)  # (*sample, *lead, *batch, K, *event)
        index = self.index.expand((*sample_shape, *self.index.shape))
        axis = index.dim()
        index = index.reshape(*index.shape, 1, *(1,) * len(self.event_shape))
        return drawn.gather(axis, index.expand((*index.shape[: axis + 1], *self.event_shape))).squeeze(axis)


@singledispatch
def about(density: Distribution, index: tuple[Tensor, ...], place: Tensor) -> Distribution:
    """X - place, where X has the density at `index` of the batch: float64, however near the place values are asked.

    Only `log_prob` is asked of the answer. Default: values are rounded where the place is added. A density that knows
    where it lies registers one that takes the place from its location: then no rounding limits how narrow it may be.

    Args:
        index: int64, one for each batch dimension; together of shape (*items) where they broadcast.
        place: (*items, 1), of densities of one number.
    """
    return _About(density, index, place)


class _About(Distribution):
    """Items of a batch, any of them any number of times, by asking for the whole batch as often as the commonest."""

    arg_constraints = {}  # noqa: RUF012  # pyright: ignore[reportAssignmentType]

    def __init__(self, density: Distribution, index: tuple[Tensor, ...], place: Tensor) -> None:
        self.density = density
        self.place = place
        self.like = density.sample(torch.Size((0,)))
        shape = torch.broadcast_shapes(place.shape[:-1], *(part.shape for part in index))
        flat = torch.zeros(shape, dtype=torch.int64, device=place.device)
        for part, size in zip(index, density.batch_shape, strict=True):
            flat = flat * size + part
        self.item = flat.flatten()
        order = self.item.argsort(stable=True)
        count = torch.bincount(self.item, minlength=density.batch_shape.numel())
        first = (count.cumsum(0) - count)[self.item[order]]
        self.turn = torch.empty_like(order)
        self.turn[order] = torch.arange(len(order), device=order.device) - first
        super().__init__(shape, density.event_shape, validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        value = (value + self.place).to(self.like.dtype)
        lead = value.shape[: value.dim() - len(self.batch_shape) - 1]
        value = value.expand(*lead, *self.batch_shape, 1).reshape(*lead, -1, 1)
        turns = int(self.turn.amax()) + 1
        whole = value.new_zeros(*lead, turns, self.density.batch_shape.numel(), 1)
        whole[..., self.turn, self.item, :] = value
        found = self.density.log_prob(whole.reshape(*lead, turns, *self.density.batch_shape, 1))
        found = found.reshape(*lead, turns, -1)[..., self.turn, self.item]
        return found.reshape(*lead, *self.batch_shape)


@singledispatch
def tempered(density: Distribution, temperature: Tensor) -> Distribution:
    """The density proportional to p^(1/T), T > 0 a scalar; same shapes and number type, differentiable in T.

    Ask `tempering.temper`, which refuses a T that makes no sense. Default (registered in `tempering`): classes are
    enumerated, and the density of one angle over the whole turn is normalised on a grid that is refined until it
    resolves the power.

    Raises:
        UserError: any other density that has not said how, or a power too narrow for the finest grid.
    """
    raise TypeError(f"{type(density).__name__} is no torch.distributions.Distribution.")


class Estimate(NamedTuple):
    """A log-density and how far chance, not the model, has moved it; all shaped alike, nats where not said otherwise.

    Attributes:
        log_mean: what log_prob says; in expectation below the truth by about standard_error²/2 (Jensen).
        debiased: log_mean + standard_error²/2.
        standard_error: of log_mean, from random draws inside the density; 0 where nothing is drawn, NaN where nobody
            knows, infinite where all that was drawn had no weight.
        samples: draws taken, int64; 0 where nothing is drawn or nobody knows.
        unresolved: bool, true where a tolerance was asked for and not reached.
    """

    log_mean: Tensor
    debiased: Tensor
    standard_error: Tensor
    samples: Tensor
    unresolved: Tensor

    def each(self, change: Callable[[Tensor], Tensor]) -> "Estimate":
        """`change` of every one of the five."""
        return Estimate(*map(change, self))


def with_error(log_mean: Tensor, standard_error: Tensor, samples: Tensor, unresolved: Tensor) -> Estimate:
    """An estimate whose `debiased` follows from its error; -∞ with an infinite error stays -∞."""
    correction = torch.where(standard_error == math.inf, 0.0, standard_error.square() / 2)
    return Estimate(log_mean, log_mean + correction, standard_error, samples, unresolved)


@singledispatch
def estimate(density: Distribution, value: Tensor) -> Estimate:
    """The log-density at `value` (*sample, *batch, *event) with its Monte Carlo error, (*sample, *batch).

    Default: log_prob with an error of NaN, "not known", since nobody has said whether log_prob draws. A density whose
    log_prob is computed without drawing registers `exactly`; one that draws registers its own.
    """
    found = exactly(density, value)
    unknown = torch.full_like(found.log_mean, math.nan)
    return with_error(found.log_mean, unknown, found.samples, found.unresolved)


def exactly(density: Distribution, value: Tensor) -> Estimate:
    """The estimate of a density whose log_prob draws nothing: `estimate.register(Mine, exactly)`."""
    log_prob = density.log_prob(value)
    samples = torch.zeros(log_prob.shape, dtype=torch.int64, device=log_prob.device)
    return Estimate(log_prob, log_prob, torch.zeros_like(log_prob), samples, samples > 0)


@singledispatch
def cdf(density: Distribution, value: Tensor) -> Tensor | None:
    """P(X ≤ y) of a density of one real, `value` (*sample, *batch, 1), float64 (*sample, *batch); None: not known.

    Default: exact where `normals` knows the density as a mixture of normals, otherwise None.
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


@singledispatch
def each_cdf(density: Distribution, value: Tensor) -> Tensor | None:
    """P(X_i ≤ y_i) of each number i by itself, whatever the others; `value` (*sample, *batch, *event), float64, shaped
    like it; None: not known.

    Default: of a few reals `cdf` of each `marginal`, of an image None. One over images registers its own, since nobody
    can ask for a hundred thousand marginals.
    """
    if len(density.event_shape) != 1:
        return None
    here = range(density.event_shape[0])
    parts = [cdf(marginal(density, index), value[..., index : index + 1]) for index in here]
    known = [part for part in parts if part is not None]
    return torch.stack(known, -1) if len(known) == len(parts) else None


@singledispatch
def arc(density: Distribution, start: Tensor, end: Tensor) -> Tensor | None:
    """Mass of the arc from `start` counter-clockwise to `end` of a density of one angle, float64; None: not known.

    Shapes as of `cdf`, radians. The arc is less than a whole turn; of equal ends it is empty. Default: None;
    `circular_moments` then gives the mass where the density is not too narrow.
    """
    return None


def turn(start: Tensor, end: Tensor) -> Tensor:
    """How far it is from `start` counter-clockwise to `end`, radians in [0, 2π], float64."""
    return torch.remainder(end.double() - start.double(), 2 * math.pi)


class Normals(NamedTuple):
    """A mixture of normals over one real: log-weights, means and standard deviations, (*batch, component), float64."""

    log_weights: Tensor
    mean: Tensor
    scale: Tensor


def one_normal(mean: Tensor, scale: Tensor) -> Normals:
    """The answer to `normals` of one that is normal itself; both of shape (*batch, 1)."""
    mean = mean.double()
    return Normals(torch.zeros_like(mean), mean, scale.double())


@singledispatch
def normals(density: Distribution) -> Normals | None:
    """The normals that a density of one real, event_shape (1,), is a mixture of. Default: None, none are known."""
    return None


@singledispatch
def mahalanobis(density: Distribution, value: Tensor) -> Tensor | None:
    """(y - μ)ᵀ Σ⁻¹ (y - μ) of a normal density over any number of reals, float64 (*sample, *batch).

    Default: None, the density is not known to be normal.
    """
    return None


@singledispatch
def peaks(density: Distribution) -> Tensor:
    """Where the density may be highest, (peak, *batch, *event): candidates, not a promise.

    Default: its mode alone. A density with several humps registers a candidate for each.
    """
    return density.mode.unsqueeze(0)


@singledispatch
def scales(density: Distribution) -> Tensor:
    """How wide each of the `peaks` of a density of one number is, (peak, *batch), in the number's unit.

    Default: the standard deviation of the normal density that is as high.
    """
    places = peaks(density)
    return (-density.log_prob(places).double()).exp() / math.sqrt(2 * math.pi)


class Slope(NamedTuple):
    """log_prob (*sample, *batch), its gradient `pull` and a `stiffness`, both (*sample, *batch, *event)."""

    log_prob: Tensor
    pull: Tensor
    stiffness: Tensor


@singledispatch
def slope(density: Distribution, value: Tensor) -> Slope | None:
    """A bound from below that touches log p at `value` y (*sample, *batch, *event); None: not known, the default.

    With pull g and stiffness h, of reals log p(y + d) ≥ log p(y) + Σ (g d - h d²/2), h > 0, and of angles
    log p(y + d) ≥ log p(y) + Σ (g sin d - h (1 - cos d)), whatever d. A mixture has both as means over its components,
    weighted by what each has of p(y) (Jensen), so a step to the bound's top never leads down (Dempster, Laird & Rubin
    1977).
    """
    return None


@singledispatch
def images(density: Distribution, channels: Collection[str]) -> dict[str, Tensor]:
    """What the density's point prediction looks like: the channels asked for and no others, each (*batch, height,
    width) or (*batch, height, width, number), as `framework.renderer.Renderer.channels` says: "color" is linear light.

    Of torch's own densities over images, event_shape (height, width, number), "color" is the mean, taken for light;
    one over the numbers of files (a target of kind "image") registers its own. Default: it draws none.

    Raises:
        UserError: nobody has said what the density draws, or it does not draw one of the channels.
    """
    raise UserError(
        f"{type(density).__name__} of event_shape {tuple(density.event_shape)} draws no {', '.join(sorted(channels))}. "
        "Register what it draws with `framework.distributions.protocol.images.register`, or leave out the metric or "
        "picture that needs it."
    )


class ValueSet(ABC):
    """The values, one set for each item of the batch, among which the target is said to lie.

    Attributes:
        promised: the share of targets that the sets are said to hold at least; None where nothing is said.
    """

    promised: float | None = None

    @abstractmethod
    def contains(self, value: Tensor) -> Tensor:
        """Whether each value (*sample, *batch, *event) is in its item's set, bool (*sample, *batch)."""

    @abstractmethod
    def size(self) -> Tensor:
        """Number of labels, radians of one angle, length of one real, volume of several; float64 (*batch)."""

    @abstractmethod
    def empty(self) -> Tensor:
        """Whether nothing is in the set, bool (*batch)."""

    def parts(self) -> "list[list[int]] | list[list[tuple[float, float]]] | None":
        """What the set of each item of the flattened batch is made of, ascending: labels of classes; (low, high) of
        one real; of one angle radians, from low in [-π, π) counter-clockwise to high, at most a turn on.

        Default: None, the set cannot be listed. What is listed is what predictions print.
        """
        return None


@singledispatch
def value_set(density: Distribution) -> ValueSet | None:
    """The set that comes with the density.

    Default: None, it has none. Structures answer None too: what was promised of a density is not so of a mixture, a
    power or a marginal of it. In another frame (`moved.Moved`) it is the same set.
    """
    return None
