"""Densities of exported models, computed with NumPy alone; `mode=export` copies this file to `densities.py`.

A density is built from the outputs of an exported network by `build`. All densities of a batch are computed together.
In shapes, `*batch` is the shape of the batch, `*event` the shape of one target, and `*sample` any dimensions before
them. Angles are in radians; log-densities and entropies are in nats. All numbers are float64.

This module and the modules of families import only NumPy and Python's own library, because an exported folder must run
where nothing else is installed.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

DRAWS = 4096
"""Number of draws of an estimated entropy, which is printed with its standard error, and of estimated medians."""
MANY = 16
"""Number of peaks or components above which computations are simplified.

If there are more peaks, neighbouring peaks share panels of a quadrature, and the search for the mode starts from the
MANY highest peaks only. If there are more components, the distribution function is computed by quadrature.
"""
STEPS = 200
"""Largest number of steps of the search for a mode and of a bisection."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_CIRCLE_NODES, _CIRCLE_WEIGHTS = np.polynomial.legendre.leggauss(96)
_LEAST = 40.0
"""Value of κ (1 - cos θ) beyond which exp(κ (cos θ - 1)) is below 1e-17."""


class Value(NamedTuple):
    """A number for each item of the batch, (*batch), and its standard error, which is 0 where nothing is drawn."""

    value: Array
    error: Array


class Interval(NamedTuple):
    """Ends of the central interval of each number, (*batch, number); for angles the arc from `low` to `high`."""

    low: Array
    high: Array


class Bound(NamedTuple):
    """A log-density at a value y, and a lower bound of the log-density that touches it at y.

    `log_prob` has the shape (*sample, *batch); gradient and curvature have the shape (*sample, *batch, *event). At
    y + d, the bound is `log_prob` + Σ (gradient · d - curvature · d²/2), or for angles
    `log_prob` + Σ (gradient · sin d - curvature · (1 - cos d)).
    """

    log_prob: Array
    gradient: Array
    curvature: Array


class Density:
    """A batch of densities.

    Attributes:
        batch: shape of the batch.
        event: shape of one target; () for classes.
        circular: whether the target consists of angles.
        reach: distance from a peak, in widths of the peak, up to which the density of one number is integrated; larger
            for heavy tails.
        by_draws: whether medians and intervals are estimated from DRAWS draws, because the densities of single angles
            are not known.
        has_sets: whether each item of the batch has a prediction set.
        stated_probability: probability with which a set is stated to contain the target; None if it is not stated.
    """

    batch: tuple[int, ...]
    event: tuple[int, ...]
    circular: bool = False
    reach: float = 40.0
    by_draws: bool = False
    has_sets: bool = False
    stated_probability: float | None = None

    @property
    def probabilities(self) -> Array:
        """Probability of each class, (*batch, class).

        Raises:
            ValueError: the target is not a class.
        """
        raise ValueError("Only classes have probabilities. Use `log_prob`.")

    def log_prob(self, value: Array) -> Array:
        """Return the log-density, nats, (*sample, *batch), at `value`, (*sample, *batch, *event)."""
        raise NotImplementedError

    def sample(self, generator: np.random.Generator, count: int) -> Array:
        """Return `count` draws, (count, *batch, *event)."""
        raise NotImplementedError

    def mode(self) -> Array:
        """Return the value of largest density, (*batch, *event)."""
        raise NotImplementedError

    def mean(self) -> Array:
        """Return the mean, (*batch, *event); classes and angles have none.

        Raises:
            ValueError: the target is a class or an angle.
        """
        raise ValueError("Classes and angles have no mean. Use the mode or the median.")

    def entropy(self) -> Value:
        """Return the entropy with its standard error: by quadrature for one number, otherwise from draws."""
        if self.event == (1,):
            points, mass = self.nodes()
            log_prob = self.log_prob(points[..., None])
            terms = np.where(mass > 0, mass * -np.where(mass > 0, log_prob, 0.0), 0.0)
            value = terms.sum(0)
            return Value(value, np.zeros_like(value))
        surprise = -self.log_prob(self.sample(np.random.default_rng(0), DRAWS))
        return Value(surprise.mean(0), surprise.std(0, ddof=1) / math.sqrt(DRAWS))

    def marginal(self, index: int) -> "Density":
        """Return the density of number `index` of the target alone, with event (1,)."""
        if self.event == (1,) and index == 0:
            return self
        raise ValueError(
            f"The density over a target of shape {self.event} has no known marginal density of one number."
        )

    def cdf(self, value: Array) -> Array:
        """Return P(X ≤ value) of one real number, (*sample, *batch), at `value` (*sample, *batch, 1)."""
        raise ValueError("The distribution function of this density is not known.")

    def arc(self, start: Array, end: Array) -> Array:
        """Return the probability of an arc of one angle, counter-clockwise from `start` to `end`, (*sample, *batch)."""
        raise ValueError("The probabilities of arcs of this density are not known.")

    def peaks(self) -> tuple[Array, Array]:
        """Return candidates for the mode of one number, (peak, *batch), and the width of the peak at each."""
        raise ValueError("The mode candidates and peak widths of this density are not known.")

    def bound(self, value: Array) -> Bound:
        """Return a lower bound of the log-density that touches it at `value` (*sample, *batch, *event)."""
        raise ValueError("The mode of a mixture of these densities is not known. Use the median.")

    def starts(self) -> Array:
        """Return values at which the search for the mode of a mixture starts, (start, *batch, *event)."""
        return self.mode()[None]

    def pick(self, index: Array, axis: int) -> "Density":
        """Return the densities that `index` chooses along one batch dimension.

        Args:
            index: indices along the batch dimension `axis`, (*batch before this dimension, count).
            axis: number of the batch dimension.
        """
        chosen = copy.copy(self)
        for name, value in vars(self).items():
            if isinstance(value, Density):
                setattr(chosen, name, value.pick(index, axis))
            elif isinstance(value, list):
                setattr(chosen, name, [part.pick(index, axis) for part in value])
            elif isinstance(value, np.ndarray) and value.shape[: axis + 1] == self.batch[: axis + 1]:
                wide = index.reshape(*index.shape, *(1,) * (value.ndim - axis - 1))
                setattr(chosen, name, np.take_along_axis(value, wide, axis))
        chosen.batch = (*index.shape, *self.batch[axis + 1 :])
        return chosen

    def parts(self) -> list[Any] | None:
        """Return the labels or intervals of the prediction set of each item of the batch; None without such sets."""
        return None

    def nodes(self) -> tuple[Array, Array]:
        """Return quadrature points of one number, and the probability that each represents, both (point, *batch).

        The points and probabilities follow Gauss's rule between the `edges`.
        """
        edges = self.edges()
        half = np.diff(edges, axis=0)[:, None] / 2
        shape = (1, -1, *(1,) * len(self.batch))
        points = edges[:-1, None] + half * (1 + _NODES.reshape(shape))
        weights = half * _WEIGHTS.reshape(shape)
        points, weights = (part.reshape(-1, *self.batch) for part in (points, weights))
        return points, weights * np.exp(self.log_prob(points[..., None]))

    def edges(self) -> Array:
        """Return the ends of the panels of a quadrature of one number, ascending, (edge, *batch).

        The distances of the ends from the peaks grow by a constant factor. For an angle, the first and the last end are
        one turn apart. If there are many peaks, the ends are rounded, so that few panels remain where peaks overlap.
        """
        place, width = self.peaks()
        steps = np.concatenate(
            [[0.0], np.geomspace(0.5, self.reach, math.ceil(4.9 * math.log10(self.reach)))]
        )
        steps = np.concatenate([-steps[:0:-1], steps]).reshape(-1, *(1,) * place.ndim)
        edges = (place + width * steps).reshape(-1, *self.batch)
        if len(place) > MANY:
            gaps = width * np.maximum(0.5, np.abs(steps) / 2)
            edges = merge(wrap(edges) if self.circular else edges, gaps.reshape(edges.shape))
        if self.circular:
            first = place[:1]
            edges = first - math.pi + np.mod(edges - first + math.pi, 2 * math.pi)
            edges = np.concatenate([first - math.pi, edges, first + math.pi])
        return np.sort(edges, 0)

    def median(self) -> Array:
        """Return the point of least expected absolute deviation, number by number, (*batch, *event)."""
        if not self.event:
            return self.mode()
        if self.by_draws:
            return self._central_of_draws(0.0)[0]
        parts = [self.marginal(index) for index in range(self.event[0])]
        find = _circular_median if self.circular else lambda part: _quantiles(part, 0.5)[0]
        return np.stack([find(part) for part in parts], -1)

    def interval(self, mass: float) -> Interval:
        """Return the central interval of each number, with probability `mass`.

        Half of the remaining probability lies beyond each end.

        For angles, `low` is in [-π, π), and the median splits the arc into two parts of equal probability.
        """
        if self.by_draws:
            return Interval(*self._central_of_draws(mass)[1:])
        parts = [self.marginal(index) for index in range(self.event[0])]
        find = _arc if self.circular else _central
        ends = [find(part, mass) for part in parts]
        return Interval(*(np.stack(side, -1) for side in zip(*ends, strict=True)))

    def _central_of_draws(self, mass: float) -> tuple[Array, Array, Array]:
        """Return the medians of DRAWS draws and the ends of their central arcs, (*batch, angle) each."""
        draws = np.sort(self.sample(np.random.default_rng(0), DRAWS).reshape(DRAWS, -1), 0)
        results = [_arc_of_draws(column, mass) for column in draws.T]
        median, low, high = (
            np.reshape(numbers, (*self.batch, *self.event)) for numbers in zip(*results, strict=True)
        )
        return median, low, high


def merge(places: Array, resolution: Array) -> Array:
    """Round positions on the real line, and return each rounded position once.

    A position is rounded to a multiple of the largest power of two that is at most its `resolution`.

    Args:
        places: positions, (place, *batch).
        resolution: largest rounding step of each position, of the same shape.

    Returns:
        Ascending positions, (place, *batch); an item with fewer positions than others repeats its last one.
    """
    step = np.exp2(np.floor(np.log2(resolution)))
    rounded = np.sort((np.round(places / step) * step).reshape(len(places), -1), 0)
    new = np.ones(rounded.shape, bool)
    new[1:] = rounded[1:] != rounded[:-1]
    order = np.argsort(~new, axis=0, kind="stable")[: int(new.sum(0).max(initial=1))]
    places_once = np.where(
        np.take_along_axis(new, order, 0), np.take_along_axis(rounded, order, 0), rounded[-1:]
    )
    return places_once.reshape(-1, *places.shape[1:])


def _arc_of_draws(angles: Array, mass: float) -> tuple[float, float, float]:
    """Return the median of ascending angles, and the ends of the central arc around it that holds the share `mass`."""
    count = len(angles)
    turn = np.concatenate([angles, angles + 2 * math.pi])
    total = np.concatenate([[0.0], np.cumsum(turn)])
    first = np.arange(count)
    middle = np.searchsorted(turn, angles + math.pi)
    ahead = total[middle] - total[first] - (middle - first) * angles
    behind = (first + count - middle) * (angles + 2 * math.pi) - (total[first + count] - total[middle])
    median = float(angles[(ahead + behind).argmin()])
    away = np.sort(wrap(angles - median))
    below, above = away[away < 0][::-1], away[away >= 0]
    ends = []
    for side, sign in ((below, -1), (above, 1)):
        rank = math.ceil(mass / 2 * count) - 1
        ends.append(0.0 if rank < 0 else float(side[rank]) if rank < len(side) else sign * math.pi)
    low = float(wrap(np.array(median + ends[0])))
    return median, low, low + ends[1] - ends[0]


class Cumulative:
    """The distribution function of a density of one number, by quadrature between the density's `edges`.

    For a mixture of many components, it takes less time than the distribution functions of all components.

    Args:
        density: the density, with event (1,).
    """

    def __init__(self, density: Density) -> None:
        self.density = density
        edges = density.edges()
        mass = density.nodes()[1].reshape(len(edges) - 1, len(_NODES), -1).sum(1)
        self.edges = edges.reshape(len(edges), -1)
        self.mass = np.concatenate([np.zeros_like(mass[:1]), np.cumsum(mass, 0)])

    def below(self, value: Array) -> Array:
        """Return the probability between the first edge and `value`; both arrays have the shape (*sample, *batch)."""
        shape = np.broadcast_shapes(value.shape, self.density.batch)
        flat = np.broadcast_to(value, shape).reshape(-1, self.edges.shape[1])
        panel = (flat >= self.edges[1:-1, None]).sum(0)
        start = np.take_along_axis(self.edges, panel, 0)
        half = np.clip(flat - start, 0, np.take_along_axis(self.edges, panel + 1, 0) - start) / 2
        points = start + half * (1 + _NODES[:, None, None])
        log_prob = self.density.log_prob(points.reshape(len(_NODES), *shape, 1)).reshape(points.shape)
        part = (half * _WEIGHTS[:, None, None] * np.exp(log_prob)).sum(0)
        return np.clip(np.take_along_axis(self.mass, panel, 0) + part, 0, 1).reshape(shape)

    def arc(self, start: Array, end: Array) -> Array:
        """Return the probability of an arc, counter-clockwise from `start` to `end`, (*sample, *batch)."""
        first = self.edges[0].reshape(self.density.batch)
        low, high = (np.mod(side - first, 2 * math.pi) for side in (start, end))
        inside = self.below(first + high) - self.below(first + low)
        return np.clip(inside + (high < low), 0, 1)


def _quantiles(density: Density, *probabilities: float) -> Array:
    """Return quantiles of one real number, (probability, *batch), by Newton's method within shrinking brackets."""
    wanted = np.reshape(probabilities, (-1, *(1,) * len(density.batch)))
    place, width = density.peaks()
    ends = []
    for side, end in ((-1, (place - width).min(0)), (1, (place + width).max(0))):
        end = np.broadcast_to(end, (len(probabilities), *density.batch))
        reach = np.broadcast_to((place + width).max(0) - (place - width).min(0), end.shape)
        for _ in range(STEPS):
            inside = side * (density.cdf(end[..., None]) - wanted) < 0
            if not inside.any():
                break
            end, reach = np.where(inside, end + side * reach, end), 2 * reach
        ends.append(end)
    low, high = ends
    value, before = low + (high - low) / 2, high - low
    for _ in range(STEPS):
        excess = density.cdf(value[..., None]) - wanted
        low, high = np.where(excess < 0, value, low), np.where(excess < 0, high, value)
        with np.errstate(all="ignore"):
            step = -excess / np.exp(density.log_prob(value[..., None]))
        # the bracket is halved where Newton's method leaves it or is slow
        newton = (value + step > low) & (value + step < high) & (np.abs(step) < before / 2)
        new = np.where(newton, value + step, low + (high - low) / 2)
        exact = np.abs(excess) <= 4e-16  # the end of a bracket, whose middle is farther away
        finished = exact | (np.abs(new - value) <= 4e-16 * np.abs(value))
        before = np.abs(new - value)
        value = np.where(exact, value, new)
        if finished.all():
            break
    return value


def _bisect(below: Any, low: Array, high: Array) -> Array:
    """Return the number between `low` and `high` at which `below` changes from true to false."""
    for _ in range(STEPS):
        middle = low + (high - low) / 2
        left = below(middle)
        low, high = np.where(left, middle, low), np.where(left, high, middle)
        if np.all((middle == low) & (high - low <= 4e-16 * np.abs(high)) | (low == high)):
            break
    return low + (high - low) / 2


def _central(density: Density, mass: float) -> tuple[Array, Array]:
    """Return the ends of the central interval of one real number, (*batch)."""
    low, high = _quantiles(density, (1 - mass) / 2, (1 + mass) / 2)
    return low, high


def _circular_median(density: Density) -> Array:
    """Return the angle of least expected absolute deviation of one angle, (*batch), radians in [-π, π)."""
    points, mass = density.nodes()
    place, width = density.peaks()
    grid = np.broadcast_to(
        np.linspace(-math.pi, math.pi, 48, endpoint=False).reshape(-1, *(1,) * len(density.batch)),
        (48, *density.batch),
    )
    near = (place + width * np.array([-4, -1, 0, 1, 4]).reshape(-1, *(1,) * place.ndim)).reshape(
        -1, *density.batch
    )
    if len(place) > MANY:
        near = merge(wrap(near), np.broadcast_to(width, (5, *width.shape)).reshape(near.shape))
    edges = np.sort(wrap(np.concatenate([grid, near, wrap(near + math.pi)])), 0)
    edges = np.concatenate([edges, edges[:1] + 2 * math.pi])

    def ahead(angle: Array) -> Array:
        return density.arc(angle, angle + math.pi) > 0.5

    # the expected deviation falls while more than half of the probability lies ahead
    more = ahead(edges)
    falls = more[:-1] & ~more[1:]
    order = np.argsort(~falls, axis=0, kind="stable")[: max(1, int(falls.sum(0).max(initial=1)))]
    ends = (np.take_along_axis(side, order, 0) for side in (edges[:-1], edges[1:]))
    roots, fits = _bisect(ahead, *ends), np.take_along_axis(falls, order, 0)
    deviation = (mass[:, None] * np.abs(wrap(points[:, None] - roots))).sum(0)
    deviation = np.where(fits, deviation, math.inf)
    best = np.take_along_axis(roots, deviation.argmin(0)[None], 0)[0]
    # a uniform density has no fall; each of its angles is a median
    return wrap(np.where(fits.any(0), best, place[0]))


def _arc(density: Density, mass: float) -> tuple[Array, Array]:
    """Return the ends of the central arc of probability `mass` of one angle, (*batch); `low` is in [-π, π)."""
    median = _circular_median(density)
    turn = np.full_like(median, math.pi)
    high = _bisect(lambda width: density.arc(median, median + width) < mass / 2, np.zeros_like(turn), turn)
    low = _bisect(lambda width: density.arc(median - width, median) < mass / 2, np.zeros_like(turn), turn)
    start = wrap(median - low)
    return start, start + low + high


def wrap(angle: Array) -> Array:
    """Return the angle in [-π, π)."""
    return np.mod(np.asarray(angle) + math.pi, 2 * math.pi) - math.pi


def half_circle_rule(concentration: Array, angle: Array) -> tuple[Array, Array]:
    """Return points and weights of a Gauss-Legendre rule for integrals over θ from 0 to `angle`.

    The rule is for integrands with the factor exp(κ (cos θ - 1)), where κ is `concentration`. The weights do not
    contain this factor, and no points are placed where it is below exp(-40).
    """
    sine = np.sqrt(_LEAST / 2 / np.maximum(concentration, _LEAST / 2))  # κ (1 - cos θ) = 2 κ sin²(θ/2)
    end = np.minimum(angle, 2 * np.arcsin(sine))
    shape = (-1, *(1,) * np.ndim(end))
    return end / 2 * (1 + _CIRCLE_NODES.reshape(shape)), end / 2 * _CIRCLE_WEIGHTS.reshape(shape)


def half_circle(concentration: Array, angle: Array) -> Array:
    """Return ∫ exp(κ (cos θ - 1)) dθ from 0 to `angle` in [0, π]; κ is `concentration`."""
    points, weights = half_circle_rule(concentration, angle)
    return (weights * np.exp(-2 * concentration * np.sin(points / 2) ** 2)).sum(0)


def bessel_i0e(value: Array) -> Array:
    """Return the modified Bessel function I₀(x) exp(-x) for x ≥ 0."""
    return half_circle(value, np.full_like(value, math.pi)) / math.pi


def log_sum_exp(terms: Array) -> Array:
    """Return log Σ exp(terms) over the last dimension; -inf if all terms are -inf."""
    largest = terms.max(-1, keepdims=True)
    shift = np.where(np.isfinite(largest), largest, 0.0)
    with np.errstate(divide="ignore"):
        return np.log(np.exp(terms - shift).sum(-1)) + shift[..., 0]


def normal_cdf(standard: Array) -> Array:
    """Return the distribution function of the standard normal density, as accurate as `math.erfc`."""
    argument = np.asarray(standard, dtype=np.float64) / -math.sqrt(2)
    return np.asarray(_erfc(argument), dtype=np.float64) / 2


_erfc = np.frompyfunc(math.erfc, 1, 1)


class Categorical(Density):
    """Classes, from logits (*batch, class)."""

    def __init__(self, logits: Array) -> None:
        self.log_probabilities = logits - log_sum_exp(logits)[..., None]
        self.batch, self.event = logits.shape[:-1], ()

    @property
    def probabilities(self) -> Array:
        """Probability of each class, (*batch, class)."""
        return np.exp(self.log_probabilities)

    def log_prob(self, value: Array) -> Array:
        value = np.asarray(value).astype(np.int64)
        lead = value.shape[: value.ndim - len(self.batch)]
        table = np.broadcast_to(self.log_probabilities, (*lead, *self.log_probabilities.shape))
        value = np.broadcast_to(value, table.shape[:-1])
        return np.take_along_axis(table, value[..., None], -1)[..., 0]

    def sample(self, generator: np.random.Generator, count: int) -> Array:
        below = np.cumsum(self.probabilities, -1)
        drawn = generator.random((count, *self.batch, 1)) * below[..., -1:]
        return (drawn > below).sum(-1)

    def mode(self) -> Array:
        return self.log_probabilities.argmax(-1)

    def entropy(self) -> Value:
        log = self.log_probabilities
        value = -(np.exp(log) * np.maximum(log, -1e4)).sum(-1)
        return Value(value, np.zeros_like(value))


class Symmetric(Density):
    """Base class of densities whose mean, mode and median are their `location`, (*batch, *event)."""

    location: Array

    def mode(self) -> Array:
        return self.location

    def mean(self) -> Array:
        return self.location

    def median(self) -> Array:
        return self.location


class Normal(Symmetric):
    """Normal densities of several numbers: each is regressed on the ones before it.

    The residuals e_i = d_i - Σ_{j<i} φ_ij d_j of the deviation d from the mean are independent N(0, σ_i²).

    Args:
        location: mean, (*batch, number).
        scale: σ, (*batch, number).
        coefficients: φ, (*batch, number, number), strictly below the diagonal; None if all are 0.
    """

    def __init__(self, location: Array, scale: Array, coefficients: Array | None = None) -> None:
        self.location, self.scale, self.coefficients = location, scale, coefficients
        self.batch, self.event = location.shape[:-1], location.shape[-1:]

    def _residual(self, value: Array) -> Array:
        deviation = value - self.location
        if self.coefficients is None:
            return deviation
        return deviation - (self.coefficients * deviation[..., None, :]).sum(-1)

    def log_prob(self, value: Array) -> Array:
        standard = self._residual(value) / self.scale
        return -(standard**2 / 2 + np.log(self.scale) + math.log(2 * math.pi) / 2).sum(-1)

    def _mixing(self) -> Array:
        """Return (I - φ)⁻¹, which maps the independent residuals to the deviations."""
        assert self.coefficients is not None
        return np.linalg.inv(np.eye(self.event[0]) - self.coefficients)

    def sample(self, generator: np.random.Generator, count: int) -> Array:
        noise = generator.standard_normal((count, *self.batch, *self.event)) * self.scale
        if self.coefficients is not None:
            noise = (self._mixing() * noise[..., None, :]).sum(-1)
        return self.location + noise

    def entropy(self) -> Value:
        value = (np.log(self.scale) + (1 + math.log(2 * math.pi)) / 2).sum(-1)
        return Value(value, np.zeros_like(value))

    def interval(self, mass: float) -> Interval:
        reach = NormalDist().inv_cdf((1 + mass) / 2) * self.deviation()
        return Interval(self.location - reach, self.location + reach)

    def deviation(self) -> Array:
        """Return the standard deviation of each number, (*batch, number)."""
        if self.coefficients is None:
            return self.scale
        return np.sqrt(((self._mixing() * self.scale[..., None, :]) ** 2).sum(-1))

    def marginal(self, index: int) -> "Normal":
        part = slice(index, index + 1)
        return Normal(self.location[..., part], self.deviation()[..., part])

    def cdf(self, value: Array) -> Array:
        return normal_cdf(((value - self.location) / self.scale)[..., 0])

    def peaks(self) -> tuple[Array, Array]:
        return self.location[None, ..., 0], self.scale[None, ..., 0]

    def bound(self, value: Array) -> Bound:
        root = (
            np.eye(self.event[0]) if self.coefficients is None else np.eye(self.event[0]) - self.coefficients
        )
        root = root / self.scale[..., None]
        precision = np.swapaxes(root, -1, -2) @ root
        deviation = value - self.location
        gradient = -(precision * deviation[..., None, :]).sum(-1)
        # the sums of the absolute values of the rows bound the matrix from above (Gershgorin)
        curvature = np.broadcast_to(np.abs(precision).sum(-1), gradient.shape)
        return Bound(self.log_prob(value), gradient, curvature)


class Uniform(Density):
    """Independent angles, each uniform over the circle; only the shape of `location`, (*batch, angle), is used."""

    circular = True

    def __init__(self, location: Array) -> None:
        self.location = np.zeros_like(location)
        self.batch, self.event = location.shape[:-1], location.shape[-1:]

    def log_prob(self, value: Array) -> Array:
        shape = np.broadcast_shapes(np.shape(value), self.location.shape)
        return np.full(shape[:-1], -self.event[0] * math.log(2 * math.pi))

    def sample(self, generator: np.random.Generator, count: int) -> Array:
        return generator.uniform(-math.pi, math.pi, (count, *self.batch, *self.event))

    def mode(self) -> Array:
        return self.location

    def marginal(self, index: int) -> "Uniform":
        return Uniform(self.location[..., index : index + 1])

    def arc(self, start: Array, end: Array) -> Array:
        return np.mod(end - start, 2 * math.pi) / (2 * math.pi) + np.zeros(self.batch)

    def peaks(self) -> tuple[Array, Array]:
        return self.location[None, ..., 0], np.ones((1, *self.batch))

    def bound(self, value: Array) -> Bound:
        none = np.zeros(np.broadcast_shapes(np.shape(value), self.location.shape))
        return Bound(self.log_prob(value), none, none)


class Mixture(Density):
    """The density Σ_k w_k p_k.

    Args:
        log_weights: log w_k up to a constant, (*batch, K).
        components: p_k, with batch (*batch, K).
    """

    def __init__(self, log_weights: Array, components: Density) -> None:
        self.log_weights = log_weights - log_sum_exp(log_weights)[..., None]
        self.components = components
        self.reach = components.reach
        self._cumulative: Cumulative | None = None  # of this batch
        self.batch, self.event = components.batch[:-1], components.event
        self.circular, self.by_draws = components.circular, components.by_draws

    @property
    def _axis(self) -> int:
        """Dimension of values (*sample, *batch, K, *event) that counts the components."""
        return -1 - len(self.event)

    @property
    def probabilities(self) -> Array:
        """Probability of each class, (*batch, class)."""
        weights = np.exp(self.log_weights)[..., None]
        return (weights * self.components.probabilities).sum(-2)  # type: ignore[attr-defined]

    def log_prob(self, value: Array) -> Array:
        value = np.expand_dims(value, self._axis)
        return log_sum_exp(self.log_weights + self.components.log_prob(value))

    def sample(self, generator: np.random.Generator, count: int) -> Array:
        chosen = Categorical(self.log_weights).sample(generator, count)
        if self.log_weights.shape[-1] > MANY and not isinstance(self.components, Stacked):
            picked = self.components.pick(np.moveaxis(chosen.astype(np.int64), 0, -1), len(self.batch))
            return np.moveaxis(picked.sample(generator, 1)[0], len(self.batch), 0)
        draws = self.components.sample(generator, count)
        index = chosen.astype(np.int64).reshape(*chosen.shape, 1, *(1,) * len(self.event))
        shape = (*index.shape[: self._axis], 1, *self.event) if self.event else index.shape
        return np.take_along_axis(draws, np.broadcast_to(index, shape), self._axis).squeeze(self._axis)

    def starts(self) -> Array:
        parts = np.moveaxis(self.components.starts(), self._axis, 0)
        return parts.reshape(-1, *self.batch, *self.event)

    def mode(self) -> Array:
        if not self.event:
            return self.probabilities.argmax(-1)
        if self.log_weights.shape[-1] == 1:
            return self.components.mode().squeeze(self._axis)
        value = self.starts()
        if len(value) > MANY:  # the highest ones
            order = np.argsort(-self.log_prob(value), 0)[:MANY]
            value = np.take_along_axis(value, order.reshape(*order.shape, *(1,) * len(self.event)), 0)
        for _ in range(STEPS):
            bound = self.bound(value)
            if self.circular:
                step = np.arctan2(bound.gradient, bound.curvature)
            else:
                step = bound.gradient / np.maximum(bound.curvature, 1e-300)
            value = value + step
            width = 1 / np.sqrt(np.maximum(bound.curvature, 1e-300))
            if np.all(np.abs(step) <= np.maximum(1e-9 * width, 4e-16 * np.abs(value))):
                break
        best = self.log_prob(value).argmax(0)
        index = best.reshape(1, *best.shape, *(1,) * len(self.event))
        mode = np.take_along_axis(value, np.broadcast_to(index, (1, *value.shape[1:])), 0)[0]
        return wrap(mode) if self.circular else mode

    def mean(self) -> Array:
        if self.circular or not self.event:
            return super().mean()
        weights = np.exp(self.log_weights)[(..., *(None,) * len(self.event))]
        return (weights * self.components.mean()).sum(self._axis)

    def median(self) -> Array:
        if self.event and self.log_weights.shape[-1] == 1:
            return self.components.median().squeeze(self._axis)
        return super().median()

    def interval(self, mass: float) -> Interval:
        if self.log_weights.shape[-1] == 1:
            return Interval(*(end.squeeze(self._axis) for end in self.components.interval(mass)))
        return super().interval(mass)

    def entropy(self) -> Value:
        if not self.event:
            return Categorical(np.log(np.maximum(self.probabilities, 1e-300))).entropy()
        if self.log_weights.shape[-1] == 1:
            return Value(*(part[..., 0] for part in self.components.entropy()))
        return super().entropy()

    def marginal(self, index: int) -> "Mixture":
        return Mixture(self.log_weights, self.components.marginal(index))

    def _many(self) -> Cumulative | None:
        """Return the distribution function by quadrature if there are many components."""
        if self.log_weights.shape[-1] <= MANY:
            return None
        if self._cumulative is None or self._cumulative.density is not self:
            self._cumulative = Cumulative(self)
        return self._cumulative

    def cdf(self, value: Array) -> Array:
        if (many := self._many()) is not None:
            return many.below(value[..., 0])
        return (np.exp(self.log_weights) * self.components.cdf(value[..., None, :])).sum(-1)

    def arc(self, start: Array, end: Array) -> Array:
        if (many := self._many()) is not None:
            return many.arc(start, end)
        return (np.exp(self.log_weights) * self.components.arc(start[..., None], end[..., None])).sum(-1)

    def peaks(self) -> tuple[Array, Array]:
        parts = (np.moveaxis(part, -1, 0) for part in self.components.peaks())
        place, width = (part.reshape(-1, *self.batch) for part in parts)
        return place, width

    def bound(self, value: Array) -> Bound:
        parts = self.components.bound(np.expand_dims(value, self._axis))
        terms = self.log_weights + parts.log_prob
        share = np.exp(terms - log_sum_exp(terms)[..., None])[(..., *(None,) * len(self.event))]
        gradient, curvature = ((share * part).sum(self._axis) for part in parts[1:])
        return Bound(log_sum_exp(terms), gradient, curvature)


class Stacked(Density):
    """K densities with batch (*batch,), read as one density with batch (*batch, K)."""

    def __init__(self, densities: Sequence[Density]) -> None:
        first = densities[0]
        self.densities = densities
        self.reach = max(density.reach for density in densities)
        self.batch, self.event, self.circular = (*first.batch, len(densities)), first.event, first.circular
        self.by_draws = any(density.by_draws for density in densities)

    @property
    def _axis(self) -> int:
        return -1 - len(self.event)

    @property
    def probabilities(self) -> Array:
        """Probability of each class, (*batch, K, class)."""
        return np.stack([part.probabilities for part in self.densities], -2)  # type: ignore[attr-defined]

    def _each(self, value: Array) -> list[tuple[Density, Array]]:
        shape = list(np.shape(value))
        shape[self._axis] = len(self.densities)
        parts = np.moveaxis(np.broadcast_to(value, shape), self._axis, 0)
        return list(zip(self.densities, parts, strict=True))

    def log_prob(self, value: Array) -> Array:
        return np.stack([density.log_prob(part) for density, part in self._each(value)], -1)

    def sample(self, generator: np.random.Generator, count: int) -> Array:
        return np.stack([density.sample(generator, count) for density in self.densities], self._axis)

    def mode(self) -> Array:
        return np.stack([density.mode() for density in self.densities], self._axis)

    def mean(self) -> Array:
        return np.stack([density.mean() for density in self.densities], self._axis)

    def entropy(self) -> Value:
        parts = [density.entropy() for density in self.densities]
        return Value(*(np.stack(side, -1) for side in zip(*parts, strict=True)))

    def starts(self) -> Array:
        return np.stack(_as_many([density.starts() for density in self.densities]), self._axis)

    def marginal(self, index: int) -> "Stacked":
        return Stacked([density.marginal(index) for density in self.densities])

    def cdf(self, value: Array) -> Array:
        return np.stack([density.cdf(part) for density, part in self._each(value)], -1)

    def arc(self, start: Array, end: Array) -> Array:
        shape = (*np.broadcast_shapes(start.shape, end.shape)[:-1], len(self.densities))
        parts = (np.moveaxis(np.broadcast_to(side, shape), -1, 0) for side in (start, end))
        return np.stack(
            [density.arc(*ends) for density, *ends in zip(self.densities, *parts, strict=True)], -1
        )

    def peaks(self) -> tuple[Array, Array]:
        parts = [density.peaks() for density in self.densities]
        place, width = (np.stack(_as_many(side), -1) for side in zip(*parts, strict=True))
        return place, width

    def bound(self, value: Array) -> Bound:
        parts = [density.bound(part) for density, part in self._each(value)]
        axes = (-1, self._axis, self._axis)
        return Bound(
            *(np.stack(side, axis) for side, axis in zip(zip(*parts, strict=True), axes, strict=True))
        )


def _as_many(parts: Sequence[Array]) -> list[Array]:
    """Return arrays with equally many entries in the first dimension; shorter ones repeat their last entry."""
    most = max(len(part) for part in parts)
    return [np.concatenate([part, np.repeat(part[-1:], most - len(part), 0)]) for part in parts]


class Affine(Density):
    """The density of location + scale · Y, for a vector Y with the density `inner`.

    Location and scale have the shape (*batch, number).
    """

    def __init__(self, location: Array, scale: Array, inner: Density) -> None:
        self.location, self.scale, self.inner = location, scale, inner
        self.batch, self.event, self.reach = inner.batch, inner.event, inner.reach
        self.has_sets, self.stated_probability = inner.has_sets, inner.stated_probability

    def parts(self) -> list[Any] | None:
        parts = self.inner.parts()
        if parts is None:
            return None
        lines = zip(self.location.reshape(-1).tolist(), self.scale.reshape(-1).tolist(), parts, strict=True)
        return [
            [(shift + factor * low, shift + factor * high) for low, high in row]
            for shift, factor, row in lines
        ]

    def log_prob(self, value: Array) -> Array:
        return self.inner.log_prob((value - self.location) / self.scale) - np.log(self.scale).sum(-1)

    def sample(self, generator: np.random.Generator, count: int) -> Array:
        return self.location + self.scale * self.inner.sample(generator, count)

    def mode(self) -> Array:
        return self.location + self.scale * self.inner.mode()

    def mean(self) -> Array:
        return self.location + self.scale * self.inner.mean()

    def median(self) -> Array:
        return self.location + self.scale * self.inner.median()

    def interval(self, mass: float) -> Interval:
        return Interval(*(self.location + self.scale * end for end in self.inner.interval(mass)))

    def entropy(self) -> Value:
        inner = self.inner.entropy()
        return Value(inner.value + np.log(self.scale).sum(-1), inner.error)

    def starts(self) -> Array:
        return self.location + self.scale * self.inner.starts()

    def marginal(self, index: int) -> "Affine":
        part = slice(index, index + 1)
        return Affine(self.location[..., part], self.scale[..., part], self.inner.marginal(index))

    def cdf(self, value: Array) -> Array:
        return self.inner.cdf((value - self.location) / self.scale)

    def peaks(self) -> tuple[Array, Array]:
        place, width = self.inner.peaks()
        return self.location[..., 0] + self.scale[..., 0] * place, self.scale[..., 0] * width

    def bound(self, value: Array) -> Bound:
        inner = self.inner.bound((value - self.location) / self.scale)
        log_prob = inner.log_prob - np.log(self.scale).sum(-1)
        return Bound(log_prob, inner.gradient / self.scale, inner.curvature / self.scale**2)


def hull(intervals: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the lowest and the highest end of `intervals`, which are in ascending order; NaN if there are none."""
    return (intervals[0][0], intervals[-1][1]) if intervals else (math.nan, math.nan)


def arc_hull(arcs: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the ends of the shortest arc that contains all `arcs` (degrees, ascending); NaN if there are none.

    The shortest arc is the complement of the widest gap between two arcs. Its lower end is in [-180, 180), and its
    upper end may exceed 180.
    """
    if not arcs:
        return math.nan, math.nan
    starts = [low for low, _ in arcs]
    gaps = [after - high for (_, high), after in zip(arcs, [*starts[1:], starts[0] + 360], strict=True)]
    last = max(range(len(gaps)), key=gaps.__getitem__)
    first = (last + 1) % len(arcs)
    high = arcs[last][1]
    return starts[first], high if first == 0 else high + 360


FAMILIES: dict[str, Any] = {
    "categorical": Categorical,
    "normal": Normal,
    "uniform": Uniform,
    "mixture": Mixture,
    "stacked": Stacked,
    "affine": Affine,
}
"""Class of each family, by the name in density.json."""


def build(layout: Mapping[str, Any], outputs: Mapping[str, Array], families: Mapping[str, Any]) -> Density:
    """Return the density that a layout of density.json describes.

    Args:
        layout: {"family": name, "parameters": {name: name of an output}, "parts": {name: layout, or list of layouts}}.
        outputs: outputs of the network, by name.
        families: class of each family.
    """
    parameters = {key: outputs[name].astype(np.float64) for key, name in layout["parameters"].items()}
    parts = {
        key: [build(each, outputs, families) for each in part]
        if isinstance(part, list)
        else build(part, outputs, families)
        for key, part in layout["parts"].items()
    }
    return families[layout["family"]](**parameters, **parts, **layout.get("settings", {}))
