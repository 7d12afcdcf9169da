"""Bernoulli densities of the numbers of an image, for exported models, computed with NumPy alone."""

import numpy as np

from framework.distributions.numpy_densities import Array, Density, Value


class BernoulliImage(Density):
    """Independent numbers of an image, each 1 with its own probability and otherwise 0.

    Args:
        logits: log-odds of 1, (*batch, height, width, number).
    """

    def __init__(self, logits: Array) -> None:
        self.logits = logits
        self.batch, self.event = logits.shape[:-3], logits.shape[-3:]

    def log_prob(self, value: Array) -> Array:
        share = np.clip(value, 0, 1)
        return (share * _log_sigmoid(self.logits) + (1 - share) * _log_sigmoid(-self.logits)).sum(
            (-3, -2, -1)
        )

    def sample(self, generator: np.random.Generator, count: int) -> Array:
        return (generator.random((count, *self.logits.shape)) < self.mean()).astype(np.float64)

    def mode(self) -> Array:
        return (self.logits > 0).astype(np.float64)

    def mean(self) -> Array:
        return np.exp(_log_sigmoid(self.logits))

    def median(self) -> Array:
        return self.mean()

    def entropy(self) -> Value:
        share = self.mean()
        parts = share * _log_sigmoid(self.logits) + (1 - share) * _log_sigmoid(-self.logits)
        value = -parts.sum((-3, -2, -1))
        return Value(value, np.zeros_like(value))


def _log_sigmoid(logits: Array) -> Array:
    return -np.logaddexp(0.0, -logits)


FAMILIES = {"bernoulli_image": BernoulliImage}
