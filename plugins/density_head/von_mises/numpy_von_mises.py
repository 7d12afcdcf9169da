"""Von Mises densities, for exported models, computed with NumPy alone."""

import math
from functools import cached_property

import numpy as np

from framework.distributions.numpy_densities import (
    Array,
    Bound,
    Density,
    Value,
    half_circle,
    half_circle_rule,
    wrap,
)


class VonMises(Density):
    """Independent von Mises densities (thesis eq. 3.3).

    Args:
        location: μ, (*batch, angle), radians.
        concentration: κ ≥ 0, (*batch, angle).
    """

    circular = True

    def __init__(self, location: Array, concentration: Array) -> None:
        self.location, self.concentration = location, concentration
        self.batch, self.event = location.shape[:-1], location.shape[-1:]

    def log_prob(self, value: Array) -> Array:
        half = np.sin((value - self.location) / 2)
        return (-2 * self.concentration * half**2 - self._log_total).sum(-1)

    @cached_property
    def _log_total(self) -> Array:
        """Return log ∫ exp(κ (cos θ - 1)) dθ over the circle, (*batch, angle)."""
        return np.log(2 * half_circle(self.concentration, np.full_like(self.concentration, math.pi)))

    def sample(self, generator: np.random.Generator, count: int) -> Array:
        shape = (count, *self.batch, *self.event)
        narrow = self.concentration > 1e8  # where NumPy's sampler loses digits, the density is normal to 1e-8
        width = 1 / np.sqrt(np.maximum(self.concentration, 1.0))
        wide = generator.vonmises(0.0, np.minimum(self.concentration, 1e8), shape)
        return wrap(self.location + np.where(narrow, width * generator.standard_normal(shape), wide))

    def mode(self) -> Array:
        return self.location

    def entropy(self) -> Value:
        points, weights = half_circle_rule(self.concentration, np.full_like(self.concentration, math.pi))
        half = np.sin(points / 2) ** 2
        mass = weights * np.exp(-2 * self.concentration * half)
        mean = (mass * 2 * half).sum(0) / mass.sum(0)  # E[1 - cos]
        value = (self._log_total + self.concentration * mean).sum(-1)
        return Value(value, np.zeros_like(value))

    def marginal(self, index: int) -> "VonMises":
        part = slice(index, index + 1)
        return VonMises(self.location[..., part], self.concentration[..., part])

    def arc(self, start: Array, end: Array) -> Array:
        location, concentration = self.location[..., 0], self.concentration[..., 0]
        length = np.mod(end - start, 2 * math.pi)
        first = wrap(start - location)
        return np.clip(_below(concentration, first + length) - _below(concentration, first), 0, 1)

    def peaks(self) -> tuple[Array, Array]:
        width = 1 / np.sqrt(np.maximum(self.concentration, 1.0))
        return self.location[None, ..., 0], width[None, ..., 0]

    def bound(self, value: Array) -> Bound:
        away = value - self.location
        return Bound(
            self.log_prob(value), -self.concentration * np.sin(away), self.concentration * np.cos(away)
        )


def _below(concentration: Array, angle: Array) -> Array:
    """Return the probability of the arc from the mean to `angle`, negative for a negative angle.

    `angle` is the distance from the mean, in [-π, 3π); a full rotation has the probability 1.
    """
    turns = np.floor((angle + math.pi) / (2 * math.pi))
    angle = angle - 2 * math.pi * turns
    concentration = np.broadcast_to(concentration, angle.shape)
    share = half_circle(concentration, np.abs(angle)) / (
        2 * half_circle(concentration, np.full_like(angle, math.pi))
    )
    return turns + np.sign(angle) * share


FAMILIES = {"von_mises": VonMises}
