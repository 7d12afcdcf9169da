"""Parts that densities of viewpoints share: the chart, the uniform density, and densities of single angles."""

import math
from collections.abc import Callable
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.distributions.circular import Circular, grid
from framework.distributions.description import PlainDensity
from framework.distributions.panels import entropy_of_one
from framework.distributions.protocol import estimate, exact_estimate, marginal, pick, take
from framework.distributions.shapes import broadcast_shapes
from framework.distributions.uniform import UniformAngles, uniform
from framework.geometry import quaternions
from framework.geometry.aligned_rotations import Frame, align
from framework.heads import angle_marginals, peak_quadrature

VOLUME = 8 * math.pi**2
"""Volume of all rotations in the coordinates azimuth a, elevation e and tilt t (CHART), ∫ cos e da de dt."""
CHART = ((-math.pi, math.pi), (-math.pi / 2, math.pi / 2), (-math.pi, math.pi))
"""Ranges of azimuth, elevation and tilt, radians. Each rotation has one viewpoint in the chart; the poles have many."""
SUMMITS = 6
"""Number of the highest maxima on a grid, near which the mode of one angle's density is searched."""


def log_volume(elevation: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return log(cos e / 8π²), nats: the log-density of uniform rotations, per radian of each angle.

    The log-density of a viewpoint is log p(R) plus this number, for a density p of its rotation R with respect to the
    rotation-invariant measure of total mass 1. `elevation` is in radians; an elevation outside ±π/2 is replaced by
    the one inside that describes the same rotation.
    """
    return torch.log(torch.cos(elevation).abs()) - math.log(VOLUME)


class ViewpointDensity(PlainDensity):
    """Base of densities of azimuth, elevation and tilt, per radian of each angle in the chart -π/2 ≤ e ≤ π/2.

    Args:
        batch_shape: batch_shape of the distribution.
        dtype: dtype of all results.
    """

    def __init__(self, batch_shape: torch.Size, dtype: torch.dtype) -> None:
        self.dtype = dtype
        super().__init__(batch_shape, torch.Size((3,)), validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        return Circular(CHART)


class MatrixDensity(ViewpointDensity):
    """Base of densities of viewpoints with a 3 × 3 matrix as parameter; its singular vectors give the mode.

    Args:
        parameter: (*batch, 3, 3); 0 is the uniform density of rotations.
        dtype: dtype of all results; by default the dtype of the parameter. All computations are in float64.
    """

    def __init__(self, parameter: Float[Tensor, "*batch 3 3"], dtype: torch.dtype | None = None) -> None:
        self.parameter = parameter
        super().__init__(parameter.shape[:-2], dtype or parameter.dtype)

    @cached_property
    def frame(self) -> Frame:
        """The proper singular value decomposition of the parameter, U S Vᵀ, without gradient."""
        return align(self.parameter)

    @property
    def mode(self) -> Float[Tensor, "*batch 3"]:
        """Viewpoint of the rotation U Vᵀ, at which log p(R) is highest, (*batch, 3).

        U S Vᵀ is the proper singular value decomposition of the parameter. The viewpoint is the mode of the density of
        rotations: the factor cos e of the density of viewpoints is not included.
        """
        return quaternions.to_viewpoint(self.frame.mode).to(self.dtype)


class UniformViewpoints(ViewpointDensity):
    """The viewpoints of uniform rotations, with the density cos e / 8π².

    Args:
        like: any tensor with the samples' number type and device.
        batch_shape: batch_shape of the distribution.
    """

    def __init__(self, like: Tensor, batch_shape: torch.Size) -> None:
        self.like = like
        super().__init__(batch_shape, like.dtype)

    @property
    def mode(self) -> Float[Tensor, "*batch 3"]:
        """A viewpoint of highest density, with elevation 0."""
        return self.like.new_zeros(*self.batch_shape, 3)

    def log_prob(self, value: Float[Tensor, "... 3"]) -> Float[Tensor, "..."]:
        shape = broadcast_shapes(value.shape[:-1], self.batch_shape)
        return log_volume(value[..., 1].double()).expand(shape).to(self.like.dtype)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape) + self.batch_shape
        azimuth, height, tilt = 2 * torch.rand(3, *shape, dtype=torch.float64, device=self.like.device) - 1
        angles = torch.stack([math.pi * azimuth, torch.asin(height), math.pi * tilt], -1)
        return angles.to(self.like.dtype)

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Return the entropy, nats: log 8π² - E log cos e, where the mean is log 2 - 1."""
        return self.like.new_full(self.batch_shape, math.log(VOLUME) + 1 - math.log(2))


class UniformElevation(PlainDensity):
    """The elevation of uniform rotations, with the density cos e / 2.

    Args:
        like: any tensor with the samples' number type and device.
        batch_shape: batch_shape of the distribution.
    """

    def __init__(self, like: Tensor, batch_shape: torch.Size) -> None:
        self.like = like
        super().__init__(batch_shape, torch.Size((1,)), validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        return Circular((CHART[1],))

    @property
    def mode(self) -> Float[Tensor, "*batch 1"]:
        """The elevation 0, at which the density is highest."""
        return self.like.new_zeros(*self.batch_shape, 1)

    def log_prob(self, value: Float[Tensor, "... 1"]) -> Float[Tensor, "..."]:
        shape = broadcast_shapes(value.shape[:-1], self.batch_shape)
        log_prob = torch.log(torch.cos(value[..., 0].double()).abs() / 2)
        return log_prob.expand(shape).to(self.like.dtype)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape) + self.batch_shape + self.event_shape
        height = 2 * torch.rand(shape, dtype=torch.float64, device=self.like.device) - 1
        return torch.asin(height).to(self.like.dtype)

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Return the entropy, which is 1 nat."""
        return self.like.new_ones(self.batch_shape)


class Angle(PlainDensity):
    """The density of one angle of a matrix Fisher density or of a mixture of them; without gradients.

    The integral over a second angle is a Bessel function. The integral over the third angle is computed by quadrature
    with nodes around the peaks (at most two for most parameters F), from the uniform density to concentrations of 1e12.
    Elevations outside the chart are read as the equivalent elevations inside.

    Args:
        joint: the density of all three angles; it draws the samples and gives the mode and the dtype.
        index: 0 for azimuth, 1 for elevation, 2 for tilt.
        frame: the matrix Fisher density, with fields of shapes (*batch, …), or the components of a mixture, with fields
            of shapes (*batch, component, …). The component dimension of a field can be 1 if all components share it.
        log_weights: log-weights of the components, (*batch, component), nats; None for a single density.
    """

    def __init__(
        self, joint: ViewpointDensity, index: int, frame: Frame, log_weights: Tensor | None = None
    ) -> None:
        self.joint = joint
        self.index = index
        self.frame = frame
        self.log_weights = log_weights
        super().__init__(joint.batch_shape, torch.Size((1,)), validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        return Circular((CHART[self.index],))

    def log_prob(self, value: Float[Tensor, "... 1"]) -> Float[Tensor, "..."]:
        return self._at(value.double().squeeze(-1)).to(self.joint.dtype)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        return self.joint.sample(sample_shape)[..., self.index : self.index + 1]

    @property
    def mode(self) -> Float[Tensor, "*batch 1"]:
        """Angle of the highest density, radians, (*batch, 1).

        The density is maximised from several starting points, and the highest result is returned. The starting points
        are the SUMMITS highest maxima on a grid, and this angle in the mode of all three angles.
        """
        points = 90
        around = grid(points, dtype=torch.float64, device=self.frame.falls.device)
        step = 2 * math.pi / points
        if self.index == 1:
            around, step = around / 2, step / 2
        height = self._log_density(around.expand(*self.batch_shape, points))
        lower = torch.maximum(height.roll(1, -1), height.roll(-1, -1))
        summits = height.where(height >= lower, -math.inf).topk(SUMMITS).indices
        starts = torch.cat([around[summits], self.joint.mode.double()[..., self.index, None]], -1)
        highest = peak_quadrature.maximum(self._log_density, starts, step)
        return highest.unsqueeze(-1).to(self.joint.dtype)

    def entropy(self) -> Tensor:
        """Return the entropy, nats, by peak_quadrature."""
        return entropy_of_one(self)

    def expectation(self, function: Callable[[Tensor], Tensor]) -> Float[Tensor, "*batch"]:
        """Return E function(angle), float64; `function` maps radians (*batch, point) to values (*batch, point)."""
        most = math.pi / 2 if self.index == 1 else math.pi
        like = self.frame.falls.new_zeros(self.batch_shape)
        points, weights = peak_quadrature.nodes(
            self._log_density, -most, most, like, periodic=self.index != 1
        )
        mass = weights * self._log_density(points).exp()
        return (mass * function(points)).sum(-1) / mass.sum(-1)

    def _log_density(self, points: Float[Tensor, "*batch point"]) -> Float[Tensor, "*batch point"]:
        return self._at(points.movedim(-1, 0)).movedim(0, -1)

    def _at(self, angle: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """Return the log-density at angles whose shape broadcasts with the batch shape, nats, float64."""
        if self.log_weights is None:
            return angle_marginals.log_marginal(angle, self.frame, self.index)
        parts = angle_marginals.log_marginal(angle.unsqueeze(-1), self.frame, self.index)
        return torch.logsumexp(self.log_weights + parts, -1)


estimate.register(UniformViewpoints, exact_estimate)
estimate.register(UniformElevation, exact_estimate)
estimate.register(Angle, exact_estimate)  # quadrature uses no random samples


@marginal.register
def _(density: UniformViewpoints, index: int) -> Distribution:
    return _uniform_angle(index, density.like, density.batch_shape)


@uniform.register
def _(density: UniformViewpoints) -> UniformViewpoints:
    return density


@uniform.register
def _(density: UniformElevation) -> UniformElevation:
    return density


@uniform.register
def _(density: Angle) -> Distribution:
    return _uniform_angle(density.index, density.joint.mode, density.batch_shape)


@pick.register
def _(density: UniformViewpoints, index: Tensor) -> UniformViewpoints:
    return UniformViewpoints(density.like, index.shape)


@pick.register
def _(density: UniformElevation, index: Tensor) -> UniformElevation:
    return UniformElevation(density.like, index.shape)


@pick.register
def _(density: MatrixDensity, index: Tensor) -> MatrixDensity:
    chosen = take(density.parameter.flatten(-2), index).unflatten(-1, (3, 3))
    return type(density)(chosen, density.dtype)


def _uniform_angle(index: int, like: Tensor, batch_shape: torch.Size) -> Distribution:
    """Return the density of one angle of uniform rotations."""
    if index == 1:
        return UniformElevation(like, batch_shape)
    return UniformAngles(like, batch_shape, torch.Size((1,)))
