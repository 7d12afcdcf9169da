"""The mixture of a density and a uniform density."""

import math
from collections.abc import Collection

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular
from framework.distributions.density import estimate_of_sum
from framework.distributions.description import DerivedDensity
from framework.distributions.exported import Exported, exported
from framework.distributions.panels import entropy_of_one, has_range
from framework.distributions.protocol import (
    Estimate,
    QuadraticBound,
    arc_probability,
    estimate,
    images,
    marginal,
    median,
    mode_candidates,
    peak_widths,
    pick,
    quadratic_bound,
    recentre,
    tempered_density,
)
from framework.distributions.tempering import tempered_classes
from framework.distributions.uniform import uniform


class Floored(DerivedDensity):
    """Mixture (1 - γ) p + γ u of a density p and a uniform density u, the floor.

    Args:
        density: p, over classes or angles.
        weight: γ, the weight of the floor, in (0, 1).
        floor: u; None means the uniform density over the support of p.
    """

    def __init__(self, density: Distribution, weight: float, floor: Distribution | None = None) -> None:
        super().__init__(density)
        self.weight = weight
        self.floor = uniform(density) if floor is None else floor
        self.has_enumerate_support = density.has_enumerate_support

    @property
    def mode(self) -> Tensor:
        """Value of highest density; it is the mode of p."""
        return self.density.mode

    def enumerate_support(self, expand: bool = True) -> Tensor:
        """Return every class, (class, *batch); without `expand`, all dimensions after the first have length 1."""
        return self.density.enumerate_support(expand)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density, nats, (*sample, *batch)."""
        return self.floored(value, self.density.log_prob(value))[0]

    def floored(self, value: Tensor, log_prob: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log-density log((1 - γ) p + γ u) at `value`, and its first part, log((1 - γ) p), nats.

        `log_prob` is log p.
        """
        above = log_prob + math.log1p(-self.weight)
        below = self.floor.log_prob(value).double() + math.log(self.weight)
        return torch.logaddexp(above, below.to(above.dtype)), above

    @torch.no_grad()
    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        """Return samples, (*sample, *batch, *event)."""
        samples = self.density.sample(torch.Size(sample_shape))
        below = self.floor.sample(torch.Size(sample_shape)).to(samples.dtype)
        chance = torch.rand(samples.shape[: samples.dim() - len(self.event_shape)], device=samples.device)
        return torch.where((chance < self.weight)[(..., *(None,) * len(self.event_shape))], below, samples)

    def entropy(self) -> Tensor:
        """Return the entropy, nats.

        It is exact for classes, by quadrature for one angle, and otherwise the mean of -log_prob over 1000 samples.
        """
        if self.event_shape == ():
            log_prob = self.log_prob(self.enumerate_support())
            return -(log_prob.exp() * log_prob).sum(0)
        if has_range(self):
            return entropy_of_one(self)
        return -self.log_prob(self.sample(torch.Size((1000,)))).mean(0)


@marginal.register
def _(density: Floored, index: int) -> Floored:
    return Floored(marginal(density.density, index), density.weight, marginal(density.floor, index))


@uniform.register
def _(density: Floored) -> Distribution:
    return density.floor


@estimate.register
def _(density: Floored, value: Tensor) -> Estimate:
    component = estimate(density.density, value)
    log_sum, above = density.floored(value, component.log_mean)
    # the floor is exact
    return estimate_of_sum(
        component.map_fields(lambda field: field.unsqueeze(-1)), above.unsqueeze(-1), log_sum
    )


@arc_probability.register
def _(density: Floored, start: Tensor, end: Tensor) -> Tensor | None:
    inside, below = arc_probability(density.density, start, end), arc_probability(density.floor, start, end)
    if inside is None or below is None:
        return None
    return (1 - density.weight) * inside + density.weight * below


@quadratic_bound.register
def _(density: Floored, value: Tensor) -> QuadraticBound | None:
    if isinstance(density.support, Circular) and density.support.ranges is not None:
        return None  # the floor itself is not constant over rotations
    component = quadratic_bound(density.density, value)
    if component is None:
        return None
    log_prob, above = density.floored(value, component.log_prob)
    share = (above - log_prob).exp().unsqueeze(-1)
    return QuadraticBound(log_prob, share * component.pull, share * component.stiffness)


@mode_candidates.register
def _(density: Floored) -> Tensor:
    return mode_candidates(density.density)


@images.register
def _(density: Floored, channels: Collection[str]) -> dict[str, Tensor]:
    return images(density.density, channels)  # images show the mode, which a floor does not change


@peak_widths.register
def _(density: Floored) -> Tensor:
    return peak_widths(density.density)


@recentre.register
def _(density: Floored, index: tuple[Tensor, ...], place: Tensor) -> Floored:
    return Floored(
        recentre(density.density, index, place), density.weight, recentre(density.floor, index, place)
    )


@median.register
def _(density: Floored, samples: int) -> Tensor:
    if isinstance(density.support, Circular) and density.support.ranges is not None:
        return median.dispatch(Distribution)(density, samples)
    # under a uniform density the expected error is the same for every angle and every label
    return median(density.density, samples)


@pick.register
def _(density: Floored, index: Tensor) -> Floored:
    return Floored(pick(density.density, index), density.weight, pick(density.floor, index))


@tempered_density.register
def _(density: Floored, temperature: Tensor) -> Distribution:
    """Return the tempered density.

    For classes it is the power of the whole density, normalised. For angles the components are tempered, as in any
    mixture: p is replaced by its power, and the floor stays as it is, since the power of a uniform density is uniform.
    """
    if density.has_enumerate_support:
        return tempered_classes(density, temperature)
    return Floored(tempered_density(density.density, temperature), density.weight, density.floor)


@exported.register
def _(density: Floored) -> Exported:
    parts = [exported(density.density), exported(density.floor)]
    like = next(tensor for _, tensor in parts[0].tensors())
    weights = torch.tensor([math.log1p(-density.weight), math.log(density.weight)], dtype=like.dtype)
    log_weights = weights.expand(*density.batch_shape, 2)
    return Exported(
        "mixture", {"log_weights": log_weights}, {"components": Exported("stacked", {}, {"densities": parts})}
    )
