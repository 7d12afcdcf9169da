"""The rotation Laplace density of a viewpoint as a torch distribution."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Categorical, Distribution, constraints

from framework.distributions.circular import Circular
from framework.distributions.description import one_line
from framework.distributions.protocol import estimate, exact_estimate, pick, take
from framework.distributions.uniform import uniform
from framework.geometry import aligned_rotations, quaternions
from plugins.density_head.rotation_laplace import functions

VOLUME = 8 * math.pi**2
"""Volume of all rotations in the coordinates azimuth a, elevation e and tilt t (CHART), ∫ cos e da de dt."""
CHART = ((-math.pi, math.pi), (-math.pi / 2, math.pi / 2), (-math.pi, math.pi))
"""Ranges of azimuth, elevation and tilt, radians."""
DRAWS = 2000
"""Number of draws from which the entropy is estimated."""


class RotationLaplace(Distribution):
    """Azimuth a, elevation e and tilt t of a rotation R with density exp(-d)/d up to a constant, d² = tr(S - AᵀR) + δ².

    Near the mode, d is proportional to the angle from it, so that log p falls linearly and not quadratically. log_prob
    is with respect to da de dt in the chart -π/2 ≤ e ≤ π/2, log p(R) + log(cos e / 8π²). An elevation outside the
    chart is read as the viewpoint of the same rotation inside.

    Args:
        parameter: A, (*batch, 3, 3); 0 is the uniform density of rotations.
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

    @property
    def mode(self) -> Float[Tensor, "*batch 3"]:
        """Viewpoint of the rotation U Vᵀ, at which log p(R) is highest; the factor cos e is not included."""
        return quaternions.to_viewpoint(aligned_rotations.align(self.parameter).mode).to(self.dtype)

    def log_prob(self, value: Float[Tensor, "... 3"]) -> Float[Tensor, "..."]:
        exact = value.double()
        square = functions.squared_distance(quaternions.of_viewpoint(exact), self.parameter)
        volume = torch.log(torch.cos(exact[..., 1]).abs()) - math.log(VOLUME)
        log_normaliser = functions.log_normaliser(self.parameter)
        return (volume - square.sqrt() - square.log() / 2 - log_normaliser).to(self.dtype)

    @torch.no_grad()
    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        frame = aligned_rotations.align(self.parameter)
        scale, log_mass = functions.log_node_weights(frame.falls)
        shape = torch.Size(sample_shape) + self.batch_shape
        if not shape.numel():
            return torch.zeros(*shape, 3, dtype=self.dtype, device=scale.device)
        mass = Categorical(logits=log_mass, validate_args=False)
        node = mass.sample(torch.Size(sample_shape))
        aligned = aligned_rotations.sample(frame.falls.expand(*shape, 3) * scale[node].unsqueeze(-1))
        return quaternions.to_viewpoint(frame.turn(aligned)).to(self.dtype)

    @torch.no_grad()
    def entropy(self) -> Tensor:
        """Return the entropy, nats, with respect to da de dt, estimated from DRAWS draws; without gradient."""
        return -self.log_prob(self.sample(torch.Size((DRAWS,)))).double().mean(0).to(self.dtype)


estimate.register(RotationLaplace, exact_estimate)


@uniform.register
def _(density: RotationLaplace) -> RotationLaplace:
    """Return the uniform density of rotations, which is cos e / 8π² on the chart."""
    return RotationLaplace(torch.zeros_like(density.parameter), density.dtype)


@pick.register
def _(density: RotationLaplace, index: Tensor) -> RotationLaplace:
    chosen = take(density.parameter.flatten(-2), index).unflatten(-1, (3, 3))
    return RotationLaplace(chosen, density.dtype)
