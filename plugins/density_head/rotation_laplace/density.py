"""The rotation Laplace density of a viewpoint as a torch distribution."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Categorical

from framework.distributions.protocol import estimate, exact_estimate, marginal
from framework.distributions.uniform import uniform
from framework.geometry import aligned_rotations, quaternions
from framework.heads.viewpoints import Angle, MatrixDensity, UniformViewpoints, log_volume
from plugins.density_head.rotation_laplace import functions

DRAWS = 2000
"""Number of draws from which the entropy is estimated."""


class RotationLaplace(MatrixDensity):
    """Azimuth a, elevation e and tilt t of a rotation R with density exp(-d)/d up to a constant, d² = tr(S - AᵀR) + δ².

    A = U S Vᵀ is the proper singular value decomposition, and δ = `SOFTENING` makes the density finite at the mode.
    Near the mode, d is proportional to the angle from it, so that log p falls linearly and not quadratically. log_prob
    is with respect to da de dt in the chart -π/2 ≤ e ≤ π/2: it is log p(R) + log(cos e / 8π²). A viewpoint with an
    elevation outside the chart is read as the viewpoint of the same rotation inside.

    Args:
        parameter: A, (*batch, 3, 3); 0 is the uniform density of rotations.
        dtype: dtype of all results; by default the dtype of the parameter. All computations are in float64.
    """

    def log_prob(self, value: Float[Tensor, "... 3"]) -> Float[Tensor, "..."]:
        exact = value.double()
        square = functions.squared_distance(quaternions.of_viewpoint(exact), self.parameter)
        log_normaliser = functions.log_normaliser(self.parameter)
        return (log_volume(exact[..., 1]) - square.sqrt() - square.log() / 2 - log_normaliser).to(self.dtype)

    @torch.no_grad()
    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        frame = self.frame
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
def _(density: RotationLaplace) -> UniformViewpoints:
    """Return the uniform density of rotations: cos e / 8π² for azimuth, elevation e and tilt, with -π/2 ≤ e ≤ π/2."""
    like = density.parameter.new_zeros((), dtype=density.dtype)
    return UniformViewpoints(like, density.batch_shape)


@marginal.register
def _(density: RotationLaplace, index: int) -> Angle:
    """Return the marginal density of one angle.

    The density of rotations is a mixture over s > 0 of densities proportional to exp(-s Σ λᵢqᵢ²); functions.py explains
    s, λ and q. The result is the mixture of the marginal densities of these components.
    """
    frame = density.frame
    scale, log_mass = functions.log_node_weights(frame.falls)
    components = aligned_rotations.Frame(
        frame.left.unsqueeze(-3), frame.right.unsqueeze(-3), frame.falls.unsqueeze(-2) * scale.unsqueeze(-1)
    )
    return Angle(density, index, components, log_mass.log_softmax(-1))
