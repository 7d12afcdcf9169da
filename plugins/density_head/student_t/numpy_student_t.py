"""Student's t densities, for exported models, computed with NumPy alone."""

import math

import numpy as np

from framework.distributions.numpy_densities import Array, Bound, Symmetric, Value

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(128)
_STEPS = 25
"""Number of steps of the recurrence of Γ after which the asymptotic series are exact to 1e-15."""
_WIDEST = 40.0
"""Distance from the location, in scales, beyond which a nearly normal density has no probability."""


class StudentT(Symmetric):
    """Independent densities of Student's t.

    Args:
        location: (*batch, number).
        scale: above 0, (*batch, number).
        freedom: degrees of freedom ν > 2, (*batch, number).
    """

    reach = 1e6

    def __init__(self, location: Array, scale: Array, freedom: Array) -> None:
        self.location, self.scale, self.freedom = location, scale, freedom
        self.batch, self.event = location.shape[:-1], location.shape[-1:]

    def log_prob(self, value: Array) -> Array:
        ratio = (value - self.location) / (self.scale * np.sqrt(self.freedom))
        tail = (self.freedom + 1) / 2 * np.log1p(np.square(ratio))
        return (self._log_peak() - np.log(self.scale) - tail).sum(-1)

    def _log_peak(self) -> Array:
        """Return the log-density at the location for the scale 1, (*batch, number)."""
        half = self.freedom / 2
        steps = half[..., None] + np.arange(_STEPS)
        inverse = 1 / (half + _STEPS)
        square = inverse**2
        series = inverse * (square * (1 / 192 - square * (1 / 640 - square * (17 / 14336))) - 1 / 8)
        # Γ(x + ½)/Γ(x) = Γ(x + n + ½)/Γ(x + n) · Π x_i/(x_i + ½)
        shifted = series + np.log1p(_STEPS / half) / 2 - np.log1p(0.5 / steps).sum(-1)
        return shifted - math.log(2 * math.pi) / 2

    def sample(self, generator: np.random.Generator, count: int) -> Array:
        shape = (count, *self.batch, *self.event)
        shrunk = generator.standard_gamma(np.broadcast_to(self.freedom / 2, shape)) / (self.freedom / 2)
        return self.location + self.scale * generator.standard_normal(shape) / np.sqrt(shrunk)

    def entropy(self) -> Value:
        half = self.freedom / 2
        steps = half[..., None] + np.arange(_STEPS)
        inverse = 1 / (half + _STEPS)
        square = inverse**2
        series = inverse / 2 + square * (
            1 / 8 - square * (1 / 64 - square * (1 / 128 - square * (17 / 2048)))
        )
        # ψ(x + ½) - ψ(x), moved by n steps: each step adds 1/x_i - 1/(x_i + ½)
        difference = series + (0.5 / (steps * (steps + 0.5))).sum(-1)
        value = (np.log(self.scale) - self._log_peak() + (self.freedom + 1) / 2 * difference).sum(-1)
        return Value(value, np.zeros_like(value))

    def marginal(self, index: int) -> "StudentT":
        part = slice(index, index + 1)
        return StudentT(self.location[..., part], self.scale[..., part], self.freedom[..., part])

    def cdf(self, value: Array) -> Array:
        # with z = √ν tan θ the density becomes a power of cos θ, which is smooth over the whole line
        standard = ((value - self.location) / self.scale)[..., 0]
        freedom, log_peak = self.freedom[..., 0], self._log_peak()[..., 0]
        end = np.minimum(
            np.arctan(np.abs(standard) / np.sqrt(freedom)), np.arctan(_WIDEST / np.sqrt(freedom))
        )
        far = freedom < 30  # the tails of these reach beyond _WIDEST
        end = np.where(far, np.arctan(np.abs(standard) / np.sqrt(freedom)), end)
        angles = end[..., None] * (1 + _NODES) / 2
        bell = np.exp((freedom[..., None] - 1) * np.log(np.cos(angles)))
        between = np.exp(log_peak) * np.sqrt(freedom) * end / 2 * (bell * _WEIGHTS).sum(-1)
        return np.clip(0.5 + np.sign(standard) * between, 0.0, 1.0)

    def peaks(self) -> tuple[Array, Array]:
        return self.location[None, ..., 0], self.scale[None, ..., 0]

    def bound(self, value: Array) -> Bound:
        residual = value - self.location
        square = np.square(residual / self.scale)
        curvature = (self.freedom + 1) / (self.freedom + square) / self.scale**2
        return Bound(self.log_prob(value), -residual * curvature, curvature)


FAMILIES = {"student_t": StudentT}
