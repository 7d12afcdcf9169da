"""The matrix Fisher density of a viewpoint as a torch distribution."""

import torch
from jaxtyping import Float
from torch import Tensor

from framework.distributions.exported import Exported, exported
from framework.distributions.protocol import estimate, exact_estimate, marginal, tempered_density
from framework.distributions.uniform import uniform
from framework.geometry import aligned_rotations as functions
from framework.geometry import quaternions
from framework.heads.viewpoints import Angle, MatrixDensity, log_volume


class MatrixFisher(MatrixDensity):
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
    and its gradients stay finite at the poles.

    Args:
        parameter: F, (*batch, 3, 3); 0 is the uniform density of rotations.
        dtype: dtype of all results; by default the dtype of the parameter. All computations are in float64.
    """

    @property
    def mean_rotation(self) -> Float[Tensor, "*batch 3 3"]:
        """The mean rotation matrix E R, differentiable in F."""
        return functions.mean_rotation(self.parameter).to(self.dtype)

    def log_prob(self, value: Float[Tensor, "... 3"]) -> Float[Tensor, "..."]:
        exact = value.double()
        of_rotation = functions.log_prob(quaternions.of_viewpoint(exact), self.parameter)
        return (of_rotation + log_volume(exact[..., 1])).to(self.dtype)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape) + self.batch_shape + self.event_shape
        aligned = functions.sample(self.frame.falls.expand(shape))
        return quaternions.to_viewpoint(self.frame.turn(aligned)).to(self.dtype)

    def entropy(self) -> Tensor:
        """Return the entropy, nats, with respect to da de dt; without gradient.

        It is the entropy of the rotation in closed form, minus E log(cos e / 8π²) by quadrature.
        """
        elevation = Angle(self, 1, self.frame)
        mean_log_volume = elevation.expectation(log_volume)
        return (functions.entropy(self.frame.falls) - mean_log_volume).to(self.dtype)


estimate.register(MatrixFisher, exact_estimate)


@marginal.register
def _(density: MatrixFisher, index: int) -> Angle:
    return Angle(density, index, density.frame)


@exported.register
def _(density: MatrixFisher) -> Exported:
    code = "plugins.density_head.matrix_fisher.numpy_matrix_fisher"
    return Exported("matrix_fisher", {"parameter": density.parameter}, code=code)


@uniform.register
def _(density: MatrixFisher) -> MatrixFisher:
    """Return the uniform density of rotations: cos e / 8π² for azimuth, elevation e and tilt, with -π/2 ≤ e ≤ π/2."""
    return MatrixFisher(torch.zeros_like(density.parameter), density.dtype)


@tempered_density.register
def _(density: MatrixFisher, temperature: Tensor) -> MatrixFisher:
    """Return the density of rotations raised to the power 1/T for the temperature T, which has the parameter F/T.

    The density of the viewpoint keeps its factor cos e / 8π², since this factor is not part of the prediction.
    """
    return MatrixFisher(density.parameter / temperature, density.dtype)
