"""Laplace densities of the numbers of an image, for exported models, computed with NumPy alone."""

import math

import numpy as np

from framework.distributions.numpy_densities import Array, Interval, Symmetric, Value


class LaplaceImage(Symmetric):
    """Independent Laplace densities of the numbers of an image.

    Args:
        location: μ, (*batch, height, width, number), sRGB as image files hold it.
        scale: b > 0, of the same shape.
    """

    def __init__(self, location: Array, scale: Array) -> None:
        self.location, self.scale = location, scale
        self.batch, self.event = location.shape[:-3], location.shape[-3:]

    def log_prob(self, value: Array) -> Array:
        return -(np.abs(value - self.location) / self.scale + np.log(2 * self.scale)).sum((-3, -2, -1))

    def sample(self, generator: np.random.Generator, count: int) -> Array:
        return self.location + generator.laplace(0.0, 1.0, (count, *self.location.shape)) * self.scale

    def entropy(self) -> Value:
        value = (1 + math.log(2) + np.log(self.scale)).sum((-3, -2, -1))
        return Value(value, np.zeros_like(value))

    def interval(self, mass: float) -> Interval:
        reach = -self.scale * math.log1p(-mass)  # P(|y - μ| > t) = exp(-t/b)
        return Interval(self.location - reach, self.location + reach)


FAMILIES = {"laplace_image": LaplaceImage}
