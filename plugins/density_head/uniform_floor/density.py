"""A density with a uniform floor."""

import math

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.distributions.density import merged
from framework.distributions.panels import entropy_of_one, has_range
from framework.distributions.protocol import (
    Estimate,
    about,
    arc,
    estimate,
    marginal,
    median,
    peaks,
    pick,
    scales,
    tempered,
    turn,
)
from framework.distributions.tempering import tempered_classes


class Floored(Distribution):
    """(1 - γ) p + γ u.

    Args:
        density: p, over classes or angles.
        weight: γ in (0, 1).
        log_uniform: log u, nats.
    """

    arg_constraints = {}  # noqa: RUF012  # pyright: ignore[reportAssignmentType]
    has_rsample = False

    def __init__(self, density: Distribution, weight: float, log_uniform: float) -> None:
        self.density = density
        self.weight = weight
        self.log_uniform = log_uniform
        self.has_enumerate_support = density.has_enumerate_support
        super().__init__(density.batch_shape, density.event_shape, validate_args=False)

    @property
    def support(self) -> constraints.Constraint | None:
        return self.density.support

    @property
    def mode(self) -> Tensor:
        return self.density.mode

    def enumerate_support(self, expand: bool = True) -> Tensor:
        return self.density.enumerate_support(expand)

    def log_prob(self, value: Tensor) -> Tensor:
        return self.floored(self.density.log_prob(value))[0]

    def floored(self, log_prob: Tensor) -> tuple[Tensor, Tensor]:
        """log_prob where that of p is `log_prob`, and the part of it that is p's: log (1 - γ) p."""
        above = log_prob + math.log1p(-self.weight)
        return torch.logaddexp(above, torch.full_like(above, math.log(self.weight) + self.log_uniform)), above

    @torch.no_grad()
    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        drawn = self.density.sample(torch.Size(sample_shape))
        if self.event_shape:
            uniform = (2 * torch.rand_like(drawn) - 1) * math.pi
        else:
            uniform = torch.randint_like(drawn, round(math.exp(-self.log_uniform)))
        floor = (
            torch.rand(drawn.shape[: drawn.dim() - len(self.event_shape)], device=drawn.device) < self.weight
        )
        return torch.where(floor[(..., *(None,) * len(self.event_shape))], uniform, drawn)

    def entropy(self) -> Tensor:
        """Nats: exact for classes, by quadrature for one angle; otherwise the mean of -log_prob over 1000 samples."""
        if self.event_shape == ():
            log_prob = self.log_prob(self.enumerate_support())
            return -(log_prob.exp() * log_prob).sum(0)
        if has_range(self):
            return entropy_of_one(self)
        return -self.log_prob(self.sample(torch.Size((1000,)))).mean(0)


@marginal.register
def _(density: Floored, index: int) -> Floored:
    share = density.log_uniform / density.event_shape[0]
    return Floored(marginal(density.density, index), density.weight, share)


@estimate.register
def _(density: Floored, value: Tensor) -> Estimate:
    found = estimate(density.density, value)
    log_sum, above = density.floored(found.log_mean)
    # the floor is exact
    return merged(found.each(lambda field: field.unsqueeze(-1)), above.unsqueeze(-1), log_sum)


@arc.register
def _(density: Floored, start: Tensor, end: Tensor) -> Tensor | None:
    inside = arc(density.density, start, end)
    if inside is None:
        return None
    return (1 - density.weight) * inside + density.weight * turn(start, end).squeeze(-1) / (2 * math.pi)


@peaks.register
def _(density: Floored) -> Tensor:
    return peaks(density.density)


@scales.register
def _(density: Floored) -> Tensor:
    return scales(density.density)


@about.register
def _(density: Floored, index: tuple[Tensor, ...], place: Tensor) -> Floored:
    return Floored(about(density.density, index, place), density.weight, density.log_uniform)


@median.register
def _(density: Floored, samples: int) -> Tensor:
    # every angle is as far from the uniform density as any other, and every label as wrong
    return median(density.density, samples)


@pick.register
def _(density: Floored, index: Tensor) -> Floored:
    return Floored(pick(density.density, index), density.weight, density.log_uniform)


@tempered.register
def _(density: Floored, temperature: Tensor) -> Distribution:
    """As of any mixture: of classes the whole; of angles p is tempered and the floor, whose power it is, stays."""
    if density.has_enumerate_support:
        return tempered_classes(density, temperature)
    return Floored(tempered(density.density, temperature), density.weight, density.log_uniform)
