"""Independent von Mises angles as a torch distribution."""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import constraints, register_kl

from framework.distributions.circular import circular
from framework.distributions.exported import Exported, exported
from framework.distributions.protocol import (
    QuadraticBound,
    Region,
    arc_length,
    arc_probability,
    estimate,
    exact_estimate,
    highest_region,
    marginal,
    pick,
    quadratic_bound,
    recentre,
    take,
    tempered_density,
    trigonometric_moments,
)
from framework.distributions.symmetric import Symmetric
from plugins.density_head.von_mises import functions, integrals, moments
from plugins.density_head.von_mises.processor import is_transformed

LARGEST = {torch.float32: torch.finfo(torch.float32).max, torch.float64: 1e300}
"""Largest κ of each dtype; a larger κ is replaced by it, so that all results stay finite numbers.

A density with this κ differs from a point mass only by its finite height.
"""


class VonMises(Symmetric):
    """Independent von Mises densities of one or more angles (thesis eq. 3.3).

    Args:
        mean: μ, (*batch, angle), radians, read modulo 2π.
        concentration: κ ≥ 0, (*batch, angle); 0 is the uniform density, and infinity is read as LARGEST.

    Raises:
        ValueError: a negative concentration.
    """

    has_rsample = False

    def __init__(
        self, mean: Float[Tensor, "*batch angle"], concentration: Float[Tensor, "*batch angle"]
    ) -> None:
        super().__init__(mean)
        self.concentration = _in_range(concentration)

    @property
    def support(self) -> constraints.Constraint:
        """Support of the density."""
        return circular

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density, nats, (*sample, *batch)."""
        return _sum(functions.log_prob(value, self.location, self.concentration))

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        """Return samples, (*sample, *batch, *event)."""
        shape = torch.Size(sample_shape) + self.batch_shape + self.event_shape
        return functions.sample(self.location.expand(shape), self.concentration.expand(shape))

    def entropy(self) -> Tensor:
        """Return the entropy, nats, (*batch)."""
        return functions.entropy(self.concentration).sum(-1)

    def half_width(self, mass: float) -> Tensor:
        """Return half the width of the arc around each mean with probability `mass`, radians, float64."""
        concentration = self.concentration.double()
        return integrals.half_width(torch.full_like(concentration, mass), concentration)


def _in_range(concentration: Tensor) -> Tensor:
    """Return κ, at most LARGEST; raise a ValueError if one is negative."""
    largest = LARGEST.get(concentration.dtype, torch.finfo(concentration.dtype).max)
    if is_transformed() or torch.compiler.is_exporting():  # no number may be read
        return concentration.clamp(max=largest)
    if concentration.numel() == 0:
        return concentration
    low, high = concentration.detach().aminmax()
    if bool((low >= 0) & (high <= largest)):
        return concentration
    negative = concentration.detach() < 0
    if bool(negative.any()):
        raise ValueError(
            f"{int(negative.sum())} of {negative.numel()} concentrations are negative, the first of them is "
            f"{concentration.detach()[negative][0].item():g}; expected κ ≥ 0. Add π to the mean instead of using a "
            "negative κ."
        )
    return concentration.clamp(max=largest)


def _sum(terms: Tensor) -> Tensor:
    """Return the sum over the last dimension; a sum of one term takes no time."""
    return terms.squeeze(-1) if terms.shape[-1] == 1 else terms.sum(-1)


estimate.register(VonMises, exact_estimate)


@marginal.register
def _(density: VonMises, index: int) -> VonMises:
    part = slice(index, index + 1)
    return VonMises(density.location[..., part], density.concentration[..., part])


@pick.register
def _(density: VonMises, index: Tensor) -> VonMises:
    return VonMises(take(density.location, index), take(density.concentration, index))


@quadratic_bound.register
def _(density: VonMises, value: Tensor) -> QuadraticBound:
    # the bound is the density: κ cos(φ + d - μ) = κ cos(φ-μ) cos d - κ sin(φ-μ) sin d
    log_prob, pull, stiffness = functions.slope(value, density.location, density.concentration)
    return QuadraticBound(log_prob.sum(-1), pull, stiffness)


@recentre.register
def _(density: VonMises, index: tuple[Tensor, ...], place: Tensor) -> VonMises:
    location = density.location.double()[index] - place
    return VonMises(location, density.concentration.double()[index].expand_as(location))


@tempered_density.register
def _(density: VonMises, temperature: Tensor) -> VonMises:
    # exp(κ cos)^(1/T) = exp(κ/T cos)
    return VonMises(density.location, density.concentration / temperature)


@register_kl(VonMises, VonMises)
def _(first: VonMises, second: VonMises) -> Tensor:
    parts = integrals.kl_divergence(
        first.location, first.concentration, second.location, second.concentration
    )
    return parts.sum(-1)


@arc_probability.register
def _(density: VonMises, start: Tensor, end: Tensor) -> Tensor:
    mean, concentration = density.location.double(), density.concentration.double()
    first = start.double()
    before = integrals.cdf(first, mean, concentration)
    through = integrals.cdf(first + arc_length(start, end), mean, concentration)
    return (through - before).squeeze(-1).clamp(0, 1)


@trigonometric_moments.register
def _(density: VonMises, count: int, weights: Tensor | None = None) -> Tensor:
    mean, concentration = (part.double().squeeze(-1) for part in (density.location, density.concentration))
    return moments.trigonometric_moments(mean, concentration, count, weights)


@exported.register
def _(density: VonMises) -> Exported:
    parameters = {"location": density.location, "concentration": density.concentration}
    return Exported("von_mises", parameters, code="plugins.density_head.von_mises.numpy_von_mises")


@highest_region.register
def _(density: VonMises, value: Tensor, mass: float, equal: Mapping[torch.dtype, float]) -> Region:
    mean, concentration = (
        number.detach().squeeze(-1) for number in (density.location, density.concentration)
    )
    double = torch.float64 in (value.dtype, mean.dtype, concentration.dtype)
    tolerance = equal[torch.float64 if double else torch.float32]
    low, high = integrals.mass_above(value.squeeze(-1), mean, concentration, tolerance)
    return Region(low, high, 2 * density.half_width(mass).squeeze(-1))
