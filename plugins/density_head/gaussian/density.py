"""Gaussian densities of several real numbers, parametrised by a regression of each number on the previous ones."""

import math
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from framework.distributions import protocol
from framework.distributions.exported import Exported, exported
from framework.distributions.symmetric import Symmetric


class Gaussian(Symmetric):
    """A Gaussian with a full covariance, written as regressions of each number on the previous ones.

    For a value y with the deviation d = y - μ from the mean, the residuals e_i = d_i - Σ_{j<i} φ_ij d_j are independent
    N(0, σ_i²). φ and σ are the modified Cholesky factors of the inverse covariance (Pourahmadi 1999, eq. 2). Any φ and
    any σ > 0 give a covariance, the log-determinant is a sum of logarithms, and no matrix is inverted for a density or
    a sample.

    Args:
        mean: μ, (*batch, number).
        scale: σ > 0, (*batch, number); these are the standard deviations if there are no coefficients.
        coefficients: (*batch, number, number), φ strictly below the diagonal, 0 elsewhere; None if all are 0.
    """

    has_rsample = True

    def __init__(
        self,
        mean: Float[Tensor, "*batch number"],
        scale: Float[Tensor, "*batch number"],
        coefficients: Float[Tensor, "*batch number number"] | None = None,
    ) -> None:
        super().__init__(mean)
        self.scale = scale
        self.coefficients = coefficients

    @property
    def variance(self) -> Tensor:
        """Variance of each number, (*batch, number)."""
        return self.stddev.square()

    @property
    def stddev(self) -> Tensor:
        """Standard deviation of each number, (*batch, number)."""
        if self.coefficients is None:
            return self.scale
        parts = self._representable(self._mixing * self.scale.unsqueeze(-2))
        largest = parts.abs().amax(-1, keepdim=True)  # its square may overflow
        return self._representable(
            ((parts / largest).square().sum(-1, keepdim=True).sqrt() * largest).squeeze(-1)
        )

    @cached_property
    def _mixing(self) -> Tensor:
        """The lower triangular matrix (I - φ)⁻¹, which maps the independent residuals e to the deviations d."""
        assert self.coefficients is not None
        identity = torch.eye(self.event_shape[0], dtype=self.scale.dtype, device=self.scale.device)
        inverse = torch.linalg.solve_triangular(
            identity - self.coefficients,
            identity.expand_as(self.coefficients),
            upper=False,
            unitriangular=True,
        )
        return self._representable(inverse)

    def _representable(self, numbers: Tensor) -> Tensor:
        """Return `numbers` unchanged if they are finite.

        Raises:
            ValueError: a number is not finite, because products of the coefficients exceed the range of the dtype.
        """
        assert self.coefficients is not None
        if not bool(numbers.isfinite().all()) and bool(self.coefficients.isfinite().all()):
            raise ValueError(
                f"The covariance of {self.event_shape[0]} numbers with regression coefficients of up to "
                f"{self.coefficients.abs().amax().item():.3g} exceeds the range of {self.scale.dtype}. The density "
                "can be computed, but samples and marginals cannot. Choose covariance=diagonal, standardise the "
                "targets, or use float64."
            )
        return numbers

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density, nats, (*sample, *batch)."""
        return self.each_log_prob(value).sum(-1)

    def each_log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density of each number given the previous ones, nats, shaped like `value`."""
        residual = value - self.location
        if self.coefficients is not None:
            residual = residual - _times(self.coefficients, residual)
        standard = residual / self.scale
        return -(standard.square() / 2 + self.scale.log() + math.log(2 * math.pi) / 2)

    def rsample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        """Return samples, (*sample, *batch, *event), differentiable in the parameters."""
        shape = torch.Size(sample_shape) + self.batch_shape + self.event_shape
        noise = torch.randn(shape, dtype=self.scale.dtype, device=self.scale.device) * self.scale
        if self.coefficients is not None:
            noise = _times(self._mixing, noise)
        return self.location + noise

    def entropy(self) -> Tensor:
        """Return the entropy, nats, (*batch)."""
        return (self.scale.log() + (1 + math.log(2 * math.pi)) / 2).sum(-1)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return matrix times vector in their dtype, also under mixed precision, where `@` would compute in bfloat16."""
    return (matrix * vector.unsqueeze(-2)).sum(-1)


protocol.estimate.register(Gaussian, protocol.exact_estimate)


@protocol.marginal.register
def _(density: Gaussian, index: int) -> Gaussian:
    part = slice(index, index + 1)
    return Gaussian(density.location[..., part], density.stddev[..., part])


@protocol.pick.register
def _(density: Gaussian, index: Tensor) -> Gaussian:
    coefficients = density.coefficients
    if coefficients is not None:
        size = coefficients.shape[-1]
        coefficients = protocol.take(coefficients.flatten(-2), index).unflatten(-1, (size, size))
    return Gaussian(protocol.take(density.location, index), protocol.take(density.scale, index), coefficients)


@protocol.quadratic_bound.register
def _(density: Gaussian, value: Tensor) -> protocol.QuadraticBound:
    residual = value - density.location
    stiffness = density.scale.square().reciprocal().expand(residual.shape)
    if density.coefficients is None:
        return protocol.QuadraticBound(density.log_prob(value), -residual * stiffness, stiffness)
    # Σ⁻¹ = Aᵀ A, A = (I - φ)/σ; the sums of the absolute values of its rows are a diagonal matrix that is an upper
    # bound (Gershgorin)
    identity = torch.eye(residual.shape[-1], dtype=residual.dtype, device=residual.device)
    root = (identity - density.coefficients) / density.scale.unsqueeze(-1)
    pull = -_times(root.mT, _times(root, residual))
    precision = (root.unsqueeze(-1) * root.unsqueeze(-2)).sum(-3)
    return protocol.QuadraticBound(
        density.log_prob(value), pull, precision.abs().sum(-1).expand(residual.shape)
    )


@protocol.recentre.register
def _(density: Gaussian, index: tuple[Tensor, ...], place: Tensor) -> Gaussian:
    location = density.location.double()[index] - place
    return Gaussian(location, density.scale.double()[index].expand_as(location))


@protocol.normals.register
def _(density: Gaussian) -> protocol.Normals | None:
    return (
        protocol.one_normal(density.location, density.scale) if tuple(density.event_shape) == (1,) else None
    )


@protocol.mahalanobis.register
def _(density: Gaussian, value: Tensor) -> Tensor:
    residual = value.double() - density.location.double()
    if density.coefficients is not None:
        residual = residual - (density.coefficients.double() @ residual.unsqueeze(-1)).squeeze(-1)
    return (residual / density.scale.double()).square().sum(-1)


@protocol.tempered_density.register
def _(density: Gaussian, temperature: Tensor) -> Gaussian:
    # every e_i is an independent N(0, σ_i²), and exp(-e²/2σ²)^(1/T) = exp(-e²/2σ²T)
    return Gaussian(density.location, density.scale * temperature.sqrt(), density.coefficients)


@exported.register
def _(density: Gaussian) -> Exported:
    parameters = {"location": density.location, "scale": density.scale}
    if density.coefficients is not None:
        parameters["coefficients"] = density.coefficients
    return Exported("normal", parameters)
