"""Prediction sets, for exported models, computed with NumPy alone."""

import math
from typing import Any

import numpy as np

from framework.distributions.numpy_densities import STEPS, Array, Density, Interval, Value, wrap


class PredictionSet(Density):
    """A density and the set of values whose log-density is at least -threshold.

    Args:
        inner: the density.
        threshold: nats; infinite if the set holds every value.
        stated_probability: probability with which a set is stated to hold the target; None if it is not known.
    """

    has_sets = True

    def __init__(self, inner: Density, threshold: float | str, stated_probability: float | None) -> None:
        self.inner, self.threshold, self.stated_probability = inner, float(threshold), stated_probability
        self.batch, self.event, self.circular, self.by_draws = (
            inner.batch,
            inner.event,
            inner.circular,
            inner.by_draws,
        )

    def contains(self, value: Array) -> Any:
        """Return whether each value (*sample, *batch, *event) is in its set, bool (*sample, *batch)."""
        return self.inner.log_prob(value) >= -self.threshold

    def parts(self) -> list[Any]:
        """Return the labels or intervals of each set; the batch is flattened.

        Intervals are pairs (low, high). For an angle, an interval is an arc in radians, from low counter-clockwise to
        high.

        Raises:
            ValueError: the target consists of several numbers, whose sets cannot be listed.
        """
        if not self.event:
            count = self.inner.probabilities.shape[-1]  # type: ignore[attr-defined]
            labels = np.arange(count).reshape(count, *(1,) * len(self.batch))
            inside = self.contains(np.broadcast_to(labels, (count, *self.batch))).reshape(count, -1)
            return [np.flatnonzero(column).tolist() for column in inside.T]
        if self.event != (1,):
            raise ValueError("A set over several numbers cannot be listed. Use `contains` to test values.")
        return self._intervals()

    def _intervals(self) -> list[list[tuple[float, float]]]:
        points = np.sort(self.inner.nodes()[0].reshape(-1, math.prod(self.batch)), 0)
        if self.circular:
            first = points[:1] - 1e-9
            points = np.concatenate([first, points, first + 2 * math.pi])
        above = self._above(points)
        # ends lie between neighbouring points of which one is inside
        low, high = points[:-1].copy(), points[1:].copy()
        cell = high - low
        for _ in range(STEPS):
            middle = low + (high - low) / 2
            same = self._above(middle) == above[:-1]
            low, high = np.where(same, middle, low), np.where(same, high, middle)
            if np.all(high - low <= 1e-13 * np.maximum(cell, np.abs(middle))):
                break
        ends = low + (high - low) / 2
        return [self._pairs(*column) for column in zip(points.T, above.T, ends.T, strict=True)]

    def _above(self, points: Array) -> Any:
        shaped = points.reshape(-1, *self.batch)
        return self.contains(shaped[..., None]).reshape(points.shape)

    def _pairs(self, points: Array, above: Any, ends: Array) -> list[tuple[float, float]]:
        """Return the intervals of one item in which the density is high enough.

        Args:
            points: ascending points.
            above: for each point, whether it is in the set.
            ends: for each pair of neighbouring points, the end of an interval that may lie between them.
        """
        changes = np.flatnonzero(above[1:] != above[:-1])
        edges = [float(ends[index]) for index in changes]
        if not edges:
            whole = (-math.pi, math.pi) if self.circular else (-math.inf, math.inf)
            return [whole] if above.any() else []
        if self.circular:
            if above[0]:  # the first arc began before the first point
                edges = [*edges[1:], edges[0] + 2 * math.pi]
            starts = [float(wrap(np.array(low))) for low in edges[::2]]
            lengths = [high - low for low, high in zip(edges[::2], edges[1::2], strict=True)]
            return sorted((low, low + length) for low, length in zip(starts, lengths, strict=True))
        if above[0]:
            edges = [-math.inf, *edges]
        if above[-1]:
            edges = [*edges, math.inf]
        return list(zip(edges[::2], edges[1::2], strict=True))

    @property
    def probabilities(self) -> Array:
        """Probability of each class, (*batch, class)."""
        return self.inner.probabilities  # type: ignore[attr-defined,no-any-return]

    def log_prob(self, value: Array) -> Array:
        return self.inner.log_prob(value)

    def sample(self, generator: np.random.Generator, count: int) -> Array:
        return self.inner.sample(generator, count)

    def mode(self) -> Array:
        return self.inner.mode()

    def mean(self) -> Array:
        return self.inner.mean()

    def median(self) -> Array:
        return self.inner.median()

    def interval(self, mass: float) -> Interval:
        return self.inner.interval(mass)

    def entropy(self) -> Value:
        return self.inner.entropy()

    def marginal(self, index: int) -> Density:
        return self.inner.marginal(index)


FAMILIES = {"prediction_set": PredictionSet}
