"""Densities raised to a power 1/T and normalised: broader than before for T > 1, narrower below."""

import math
from functools import singledispatch
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import (
    Categorical,
    Distribution,
    Independent,
    MultivariateNormal,
    Normal,
    constraints,
)

from framework.distributions.batch_shapes import Reshaped, Stacked
from framework.distributions.circular import grid, wrap
from framework.distributions.density import Circular, Mixture
from framework.distributions.monte_carlo import SampledMixture
from framework.errors import UserError

POINTS, MOST_POINTS = 1024, 2**15
"""Of the grid on which the power of any density of one angle is normalised: doubled until it resolves it."""
RESOLVED = 1e-4
"""Two grids, one twice as fine, that agree on log ∫ p^(1/T) this far, nats, resolve the density."""


def temper(density: Distribution, temperature: Float[Tensor, ""]) -> Distribution:
    """The density proportional to p^(1/T), of the same shapes and number type; differentiable in T.

    T = 1 gives the density itself, unless a gradient in T is asked for. Of a mixture see `tempered`.

    Args:
        temperature: T > 0, a scalar.

    Raises:
        ValueError: T is not above 0, or not finite.
        UserError: nothing is known of such a density; says how to register it.
    """
    value = float(temperature.detach())
    if not 0 < value < math.inf:
        raise ValueError(f"temperature = {value}; wanted a finite number above 0.")
    if value == 1 and not temperature.requires_grad:
        return density
    return tempered(density, temperature)


@singledispatch
def tempered(density: Distribution, temperature: Tensor) -> Distribution:
    """What `temper` returns for each type of density; others register theirs: `@tempered.register`.

    Without a registration classes are enumerated, and the density of one angle that runs over the whole turn is
    normalised on a grid.
    """
    if density.has_enumerate_support and density.event_shape == ():
        return tempered_classes(density, temperature)
    support = density.support if tuple(density.event_shape) == (1,) else None
    if isinstance(support, Circular) and support.ranges is None:
        return CircularPower(density, temperature)
    raise UserError(
        f"No temperature is known for {type(density).__name__} over {tuple(density.event_shape)} numbers: p^(1/T) has "
        "no normaliser in closed form that the framework knows. Register it with "
        "`framework.distributions.tempering.tempered.register`, "
        "or leave out the wrapper that changes the temperature."
    )


def tempered_classes(density: Distribution, temperature: Tensor) -> Categorical:
    """p_k^(1/T) / Σ_j p_j^(1/T): logits divided by T (Guo et al. 2017, eq. 9), of any density over classes."""
    log_prob = log_probabilities(density)
    # the largest first, so that differences and not sizes are rounded; a class that is ruled out stays so
    heights = log_prob - log_prob.amax(-1, keepdim=True)
    return Categorical(logits=divided(heights, temperature).log_softmax(-1), validate_args=False)


def log_probabilities(density: Distribution) -> Float[Tensor, "*batch label"]:
    """Of every class, nats."""
    return density.log_prob(density.enumerate_support()).movedim(0, -1)


def divided(log_density: Tensor, temperature: Tensor) -> Tensor:
    """log p / T; -∞ stays, without a gradient."""
    ruled_out = log_density == -math.inf
    return torch.where(ruled_out, -math.inf, log_density.masked_fill(ruled_out, 0.0) / temperature)


@tempered.register
def _(density: Mixture, temperature: Tensor) -> Distribution:
    """Of classes the whole mixture. Otherwise its components are tempered and their weights kept: Σ w_k p_k raised to
    a power has no normaliser in closed form, while this is normalised as its components are, is p at T = 1, and of one
    component is the same. It keeps apart what the components say of different modes."""
    if density.has_enumerate_support:
        return tempered_classes(density, temperature)
    return Mixture(density.log_weights, tempered(density.components, temperature))


@tempered.register
def _(density: SampledMixture, temperature: Tensor) -> Distribution:
    """Component by component, also of classes, so that its log-density stays an estimate with its error."""
    components = tempered(density.components, temperature)
    return SampledMixture(density.log_weights, components, density.replicates)


@tempered.register
def _(density: Stacked, temperature: Tensor) -> Distribution:
    return Stacked([tempered(one, temperature) for one in density.densities])


@tempered.register
def _(density: Reshaped, temperature: Tensor) -> Distribution:
    return Reshaped(tempered(density.density, temperature), density.batch_shape)


@tempered.register
def _(density: Independent, temperature: Tensor) -> Distribution:
    # the power of a product is the product of the powers
    base = tempered(density.base_dist, temperature)
    return Independent(base, density.reinterpreted_batch_ndims, validate_args=False)


@tempered.register
def _(density: Normal, temperature: Tensor) -> Distribution:
    # exp(-d²/2σ²)^(1/T) = exp(-d²/2σ²T)
    return Normal(density.loc, density.scale * temperature.sqrt(), validate_args=False)


@tempered.register
def _(density: MultivariateNormal, temperature: Tensor) -> Distribution:
    scale = density.scale_tril * temperature.sqrt()
    return MultivariateNormal(density.loc, scale_tril=scale, validate_args=False)


class CircularPower(Distribution):
    """p^(1/T) / Z for the density p of one angle, by the trapezium rule.

    The grid starts at the mode, so that a peak is not missed, and is refined until it resolves the power. Samples are
    drawn from the distribution function on the grid, linear between its points.

    Args:
        density: p, event_shape (1,), over the whole turn.
        temperature: T.

    Raises:
        UserError: the power is too narrow for the finest grid.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}
    has_rsample = False

    def __init__(self, density: Distribution, temperature: Tensor) -> None:
        self.density = density
        self.temperature = temperature
        super().__init__(density.batch_shape, density.event_shape, validate_args=False)
        self.start = density.mode.detach() if density.batch_shape.numel() else density.sample()
        points = POINTS
        while True:
            log_prob = self._log_prob_at(points)  # (points, *batch), the first at the mode
            self.top = log_prob[0]
            self.powers = divided(log_prob - self.top, temperature)
            log_mean, coarse = (self.powers[::every].logsumexp(0) + math.log(every) for every in (1, 2))
            off = (log_mean - coarse).detach().abs()
            if not (off > RESOLVED).any():  # a NaN is not resolved by any grid: log_prob shows it
                break
            points *= 2
            if points > MOST_POINTS:
                raise UserError(
                    f"{type(density).__name__} at temperature {float(temperature.detach()):g} is too narrow for a grid "
                    f"of {MOST_POINTS} angles (its mass is uncertain by {off.max().item():.2g} nats). Register "
                    "its power with `framework.distributions.tempering.tempered.register`, or raise the temperature's "
                    "lower bound."
                )
        self.log_normaliser = log_mean + math.log(2 * math.pi / points)

    @property
    def support(self) -> constraints.Constraint | None:
        return self.density.support

    @property
    def mode(self) -> Tensor:
        return self.density.mode

    def log_prob(self, value: Tensor) -> Tensor:
        # below the mode's, so that large log-densities do not cancel
        return divided(self.density.log_prob(value) - self.top, self.temperature) - self.log_normaliser

    @torch.no_grad()
    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape)
        draws = torch.rand(shape.numel(), *self.batch_shape, dtype=torch.float64, device=self.start.device)
        height = self.powers.double().softmax(0)
        # mass of the cell between a point and the next, whose ends' heights count half each
        mass = ((height + height.roll(-1, 0)) / 2).reshape(len(height), -1).T
        until = mass.cumsum(-1)
        flat = draws.reshape(shape.numel(), len(until)).T.contiguous() * until[:, -1:]
        cell = torch.searchsorted(until, flat, right=True).clamp(max=len(height) - 1)
        part = 1 - (until.gather(-1, cell) - flat) / mass.gather(-1, cell).clamp(min=1e-300)
        step = (2 * math.pi / len(height)) * (cell + part.clamp(0, 1))
        found = wrap(self.start.double() + step.T.reshape(*shape, *self.batch_shape, 1))
        return found.to(self.start.dtype)

    def entropy(self) -> Tensor:
        """log Z less the mean of log p^(1/T), nats, by the trapezium rule."""
        mass = self.powers.softmax(0)
        # p log p → 0 as p → 0; the clamp keeps 0 · (-inf) from being NaN
        return self.log_normaliser - (mass * self.powers.clamp(min=-1e4)).sum(0)

    def _log_prob_at(self, points: int) -> Tensor:
        turn = grid(points, dtype=self.start.dtype, device=self.start.device) + math.pi
        ahead = turn.reshape(points, *(1,) * self.start.dim())
        return self.density.log_prob(self.start + ahead)
