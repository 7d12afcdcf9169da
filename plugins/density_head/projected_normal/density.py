"""Independent projected normal angles as a torch distribution."""

import math
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import constraints

from framework.distributions.circular import circular, grid, wrap
from framework.distributions.description import PlainDensity
from framework.distributions.panels import entropy_of_one
from framework.distributions.protocol import (
    estimate,
    even_sample,
    exact_estimate,
    marginal,
    mode_candidates,
    pick,
    take,
)
from framework.heads.peak_quadrature import refine
from plugins.density_head.projected_normal import functions

POINTS = 180
"""Number of angles of the grid on which the search for the mode begins."""
GOLDEN = (math.sqrt(5) - 1) / 2
"""Step of the lattice of `even_sample` in its second coordinate."""


class ProjectedNormal(PlainDensity):
    """Directions of independent normal vectors N(μ, P⁻¹) in the plane, one for each angle.

    The density has one or two peaks and may be skewed. With s = t = 0, P is the unit matrix, and the density is
    symmetric around the direction of μ.

    Args:
        mean: μ, (*batch, angle, 2).
        factor: s and t of P = LLᵀ with L = [[exp(s), 0], [t, exp(-s)]], (*batch, angle, 2).
        dtype: dtype of all results; by default that of `mean`. All computations are in float64.
    """

    def __init__(
        self,
        mean: Float[Tensor, "*batch angle 2"],
        factor: Float[Tensor, "*batch angle 2"],
        dtype: torch.dtype | None = None,
    ) -> None:
        self.mean_vector, self.factor = mean, factor
        self.dtype = dtype or mean.dtype
        super().__init__(mean.shape[:-2], mean.shape[-2:-1], validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        return circular

    def log_prob(self, value: Tensor) -> Tensor:
        return self._of_each(value).sum(-1).to(self.dtype)

    def _of_each(self, value: Tensor) -> Tensor:
        """Return the log-density of each angle, float64."""
        return functions.log_prob(value.double(), self.mean_vector.double(), self.factor.double())

    @torch.no_grad()
    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape) + self.batch_shape + self.event_shape
        return self._directions(*torch.randn(2, *shape, dtype=torch.float64, device=self.mean_vector.device))

    @torch.no_grad()
    def even_sample(self, count: int) -> Tensor:
        """Return `count` angles, (count, *batch, angle), whose shares in arcs differ little from the probabilities.

        They are the directions of points of a lattice in the unit square, with a random shift, that the map of Box &
        Muller 1958 turns into normal vectors.
        """
        shape = (*self.batch_shape, *self.event_shape)
        shift = torch.rand(2, *shape, dtype=torch.float64, device=self.mean_vector.device)
        number = torch.arange(count, dtype=torch.float64, device=shift.device).reshape(-1, *(1,) * len(shape))
        share = torch.remainder((number + 0.5) / count + shift[0], 1)
        turn = 2 * math.pi * torch.remainder(number * GOLDEN + shift[1], 1)
        length = (-2 * torch.log1p(-share)).sqrt()
        return self._directions(length * turn.cos(), length * turn.sin())

    def _directions(self, first: Tensor, second: Tensor) -> Tensor:
        """Return the directions of normal vectors that are computed from independent standard normal numbers."""
        grow, shear = self.factor.double().unbind(-1)
        # L⁻ᵀ z has the covariance (LLᵀ)⁻¹
        second = torch.exp(grow) * second
        first = torch.exp(-grow) * (first - shear * second)
        x, y = self.mean_vector.double().unbind(-1)
        return torch.atan2(y + second, x + first).to(self.dtype)

    @property
    @torch.no_grad()
    def mode(self) -> Tensor:
        """Angles of the highest densities, (*batch, angle)."""
        best = self._of_each(self.candidates).argmax(0, keepdim=True)
        return self.candidates.gather(0, best).squeeze(0).to(self.dtype)

    @cached_property
    @torch.no_grad()
    def candidates(self) -> Float[Tensor, "3 *batch angle"]:
        """Three candidates for the mode of each angle's density, at least one of which is the mode, float64.

        The search begins at the two highest maxima on a grid, and at the direction of μ, around which a concentrated
        density has its only peak.
        """
        around = grid(POINTS, dtype=torch.float64, device=self.mean_vector.device)
        height = self._of_each(around.reshape(POINTS, *(1,) * (len(self.batch_shape) + 1)))
        higher = height >= torch.maximum(height.roll(1, 0), height.roll(-1, 0))
        summits = height.where(higher, -math.inf).topk(2, 0).indices
        x, y = self.mean_vector.double().unbind(-1)
        start = torch.cat([around[summits], torch.atan2(y, x).unsqueeze(0)]).movedim(0, -1)
        reach = torch.full_like(start, 2 * math.pi / POINTS)
        # |P| = 1: no direction of the normal vector is wider than the norm of L
        norm = 1 + self.factor.double().abs().sum(-1).exp()
        reach[..., 2] = (4 * norm / torch.hypot(x, y).clamp(min=1e-300)).clamp(max=2 * math.pi / POINTS)

        def log_density(points: Tensor) -> Tensor:
            return self._of_each(points.movedim(-1, 0)).movedim(0, -1)

        return wrap(refine(log_density, start, reach, start - reach, start + reach)[0]).movedim(-1, 0)

    def entropy(self) -> Tensor:
        """Return the entropy, nats, (*batch), by quadrature; without gradient."""
        parts = [entropy_of_one(marginal(self, index)) for index in range(self.event_shape[0])]
        return torch.stack(parts).sum(0).to(self.dtype)


estimate.register(ProjectedNormal, exact_estimate)


@even_sample.register
def _(density: ProjectedNormal, count: int) -> Tensor:
    return density.even_sample(count)


@marginal.register
def _(density: ProjectedNormal, index: int) -> ProjectedNormal:
    part = slice(index, index + 1)
    return ProjectedNormal(density.mean_vector[..., part, :], density.factor[..., part, :], density.dtype)


@pick.register
def _(density: ProjectedNormal, index: Tensor) -> ProjectedNormal:
    mean, factor = (
        take(part.flatten(-2), index).unflatten(-1, (-1, 2)) for part in (density.mean_vector, density.factor)
    )
    return ProjectedNormal(mean, factor, density.dtype)


@mode_candidates.register
def _(density: ProjectedNormal) -> Tensor:
    return torch.cat([density.mode.unsqueeze(0), density.candidates.to(density.dtype)])
