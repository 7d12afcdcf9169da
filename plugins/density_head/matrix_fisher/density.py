"""The matrix Fisher density of a viewpoint as a torch distribution, and the densities of its single angles."""

import math
from collections.abc import Callable
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.distributions.circular import Circular, grid
from framework.distributions.description import one_line
from framework.distributions.exported import Exported, exported
from framework.distributions.panels import entropy_of_one
from framework.distributions.protocol import estimate, exact_estimate, marginal, pick, take, tempered_density
from framework.distributions.uniform import uniform
from framework.geometry import aligned_rotations as functions
from framework.geometry import quaternions
from plugins.density_head.matrix_fisher import angles, quadrature

VOLUME = 8 * math.pi**2
"""Volume of all rotations in the coordinates azimuth a, elevation e and tilt t (CHART), ∫ cos e da de dt."""
CHART = ((-math.pi, math.pi), (-math.pi / 2, math.pi / 2), (-math.pi, math.pi))
"""Ranges of azimuth, elevation and tilt, radians."""
SUMMITS = 6
"""Number of maxima on a grid, the highest ones, near which the mode of one angle's density is searched."""


class MatrixFisher(Distribution):
    """Azimuth a, elevation e and tilt t of a rotation R with density exp(tr(FᵀR)) / c(F) (Downs 1972).

    R is framework.geometry.rotation.viewpoint_rotation(a, e, t). Every rotation has one viewpoint in the chart
    -π/2 ≤ e ≤ π/2 (the poles have many), and log_prob is with respect to da de dt there:

        log p(a, e, t) = log p(R) + log(cos e / 8π²),

    where p(R) is with respect to the rotation-invariant measure of total mass 1. The density integrates to 1 over the
    chart, and samples lie in the chart. A viewpoint with an elevation outside the chart is read as the viewpoint of the
    same rotation inside, (a+π, π-e, t+π), so that the density would integrate to 2 over the torus of all three angles.
    Independent von Mises angles integrate to 1 over this torus, and their probability outside the chart is lost. So
    their log-density at data in the chart is lower by up to log 2.

    At the poles the density is 0 with respect to da de dt. No floating-point number is exactly π/2, so that log_prob
    and its gradients stay finite there.

    Args:
        parameter: F, (*batch, 3, 3); 0 is the uniform density of rotations.
        dtype: dtype of all results; by default the dtype of the parameter. All computations are in float64.
    """

    arg_constraints = {}  # noqa: RUF012  # pyright: ignore[reportAssignmentType]
    has_rsample = False
    __repr__ = one_line

    def __init__(self, parameter: Float[Tensor, "*batch 3 3"], dtype: torch.dtype | None = None) -> None:
        self.parameter = parameter
        self.dtype = dtype or parameter.dtype
        super().__init__(parameter.shape[:-2], torch.Size((3,)), validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        return Circular(CHART)

    @cached_property
    def frame(self) -> functions.Frame:
        """The proper singular value decomposition of F, without gradient."""
        return functions.align(self.parameter)

    @property
    def mean_rotation(self) -> Float[Tensor, "*batch 3 3"]:
        """The mean rotation matrix E R, differentiable in F."""
        return functions.mean_rotation(self.parameter).to(self.dtype)

    @property
    def mode(self) -> Float[Tensor, "*batch 3"]:
        """Viewpoint of the rotation U Vᵀ, at which log p(R) is highest, (*batch, 3).

        This is the mode of the rotation's density: the factor cos e of the viewpoint's density is not included.
        """
        return quaternions.to_viewpoint(self.frame.mode).to(self.dtype)

    def log_prob(self, value: Float[Tensor, "... 3"]) -> Float[Tensor, "..."]:
        exact = value.double()
        of_rotation = functions.log_prob(quaternions.of_viewpoint(exact), self.parameter)
        return (of_rotation + _log_volume(exact[..., 1])).to(self.dtype)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape) + self.batch_shape + self.event_shape
        aligned = functions.sample(self.frame.falls.expand(shape))
        return quaternions.to_viewpoint(self.frame.turn(aligned)).to(self.dtype)

    def entropy(self) -> Tensor:
        """Return the entropy, nats, with respect to da de dt; without gradient.

        It is the entropy of the rotation in closed form, minus E log(cos e / 8π²) by quadrature.
        """
        elevation = Angle(self, 1)
        log_volume = elevation.expectation(_log_volume)
        return (functions.entropy(self.frame.falls) - log_volume).to(self.dtype)


class Angle(Distribution):
    """The density of one angle of a matrix Fisher density; without gradients.

    The integral over a second angle is a Bessel function. The integral over the third angle is computed by quadrature
    with nodes around the peaks (at most two for most F), from the uniform density to concentrations of 1e12. Elevations
    outside the chart are read as the equivalent elevations inside.

    Args:
        joint: the density of all three angles.
        index: 0 for azimuth, 1 for elevation, 2 for tilt.
    """

    arg_constraints = {}  # noqa: RUF012  # pyright: ignore[reportAssignmentType]
    has_rsample = False
    __repr__ = one_line

    def __init__(self, joint: MatrixFisher, index: int) -> None:
        self.joint = joint
        self.index = index
        super().__init__(joint.batch_shape, torch.Size((1,)), validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        return Circular((CHART[self.index],))

    def log_prob(self, value: Float[Tensor, "... 1"]) -> Float[Tensor, "..."]:
        log_prob = angles.log_marginal(value.double().squeeze(-1), self.joint.frame, self.index)
        return log_prob.to(self.joint.dtype)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        return self.joint.sample(sample_shape)[..., self.index : self.index + 1]

    @property
    def mode(self) -> Float[Tensor, "*batch 1"]:
        """Angle of the highest density, radians, (*batch, 1).

        It is the highest of the peaks near the SUMMITS maxima on a grid and near this angle of the joint mode.
        """
        points = 90
        around = grid(points, dtype=torch.float64, device=self.joint.parameter.device)
        step = 2 * math.pi / points
        if self.index == 1:
            around, step = around / 2, step / 2
        height = self._log_density(around.expand(*self.batch_shape, points))
        lower = torch.maximum(height.roll(1, -1), height.roll(-1, -1))
        summits = height.where(height >= lower, -math.inf).topk(SUMMITS).indices
        starts = torch.cat([around[summits], self.joint.mode.double()[..., self.index, None]], -1)
        highest = quadrature.maximum(self._log_density, starts, step)
        return highest.unsqueeze(-1).to(self.joint.dtype)

    def entropy(self) -> Tensor:
        """Return the entropy, nats, by quadrature."""
        return entropy_of_one(self)

    def expectation(self, function: Callable[[Tensor], Tensor]) -> Float[Tensor, "*batch"]:
        """Return E function(angle), float64; `function` maps radians (*batch, point) to values (*batch, point)."""
        most = math.pi / 2 if self.index == 1 else math.pi
        like = self.joint.frame.falls[..., 0]
        points, weights = quadrature.nodes(self._log_density, -most, most, like, periodic=self.index != 1)
        mass = weights * self._log_density(points).exp()
        return (mass * function(points)).sum(-1) / mass.sum(-1)

    def _log_density(self, points: Float[Tensor, "*batch point"]) -> Float[Tensor, "*batch point"]:
        return angles.log_marginal(points.movedim(-1, 0), self.joint.frame, self.index).movedim(0, -1)


def _log_volume(elevation: Tensor) -> Tensor:
    return torch.log(torch.cos(elevation).abs()) - math.log(VOLUME)


estimate.register(MatrixFisher, exact_estimate)
estimate.register(Angle, exact_estimate)  # quadrature uses no random samples


@marginal.register
def _(density: MatrixFisher, index: int) -> Angle:
    return Angle(density, index)


@exported.register
def _(density: MatrixFisher) -> Exported:
    code = "plugins.density_head.matrix_fisher.numpy_matrix_fisher"
    return Exported("matrix_fisher", {"parameter": density.parameter}, code=code)


@uniform.register
def _(density: MatrixFisher) -> MatrixFisher:
    """Return the uniform density of rotations, Haar's measure, which is cos e / 8π² on the chart."""
    return MatrixFisher(torch.zeros_like(density.parameter), density.dtype)


@uniform.register
def _(density: Angle) -> Angle:
    return Angle(uniform(density.joint), density.index)  # pyright: ignore[reportArgumentType]


@pick.register
def _(density: MatrixFisher, index: Tensor) -> MatrixFisher:
    chosen = take(density.parameter.flatten(-2), index).unflatten(-1, (3, 3))
    return MatrixFisher(chosen, density.dtype)


@tempered_density.register
def _(density: MatrixFisher, temperature: Tensor) -> MatrixFisher:
    """Return the density of rotations raised to the power 1/T for the temperature T, which has the parameter F/T.

    The density of the viewpoint keeps the chart's factor cos e as it is, since this factor is not part of the
    prediction.
    """
    return MatrixFisher(density.parameter / temperature, density.dtype)
