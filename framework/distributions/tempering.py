"""Densities raised to a power 1/T and normalised: broader than before for T > 1, narrower below."""

import math
from collections.abc import Collection
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Categorical, Distribution, constraints

from framework.distributions.circular import Circular, grid, wrap
from framework.distributions.density import Mixture
from framework.distributions.protocol import (
    Estimate,
    Slope,
    estimate,
    images,
    peaks,
    slope,
    tempered,
    with_error,
)
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


@tempered.register(Distribution)
def _(density: Distribution, temperature: Tensor) -> Distribution:
    if density.has_enumerate_support and density.event_shape == ():
        return tempered_classes(density, temperature)
    support = density.support if tuple(density.event_shape) == (1,) else None
    if isinstance(support, Circular) and support.ranges is None:
        return CircularPower(density, temperature)
    raise UserError(
        f"No temperature is known for {type(density).__name__} over {tuple(density.event_shape)} numbers: p^(1/T) has "
        "no normaliser in closed form that the framework knows. Register it with "
        "`framework.distributions.protocol.tempered.register`, "
        "or leave out the wrapper that changes the temperature."
    )


@tempered.register
def _(density: Mixture, temperature: Tensor) -> Distribution:
    """Of classes the whole mixture. Otherwise its components are tempered and their weights kept: Σ w_k p_k raised to
    a power has no normaliser in closed form, while this is normalised as its components are, is p at T = 1, and of one
    component is the same. It keeps apart what the components say of different modes."""
    if density.has_enumerate_support:
        return tempered_classes(density, temperature)
    return Mixture(density.log_weights, tempered(density.components, temperature))


def tempered_classes(density: Distribution, temperature: Tensor) -> "RescaledClasses":
    """p_k^(1/T) / Σ_j p_j^(1/T): logits divided by T (Guo et al. 2017, eq. 9), of any density over classes."""
    log_prob = log_probabilities(density)
    # the largest first, so that differences and not sizes are rounded; a class that is ruled out stays so
    heights = log_prob - log_prob.amax(-1, keepdim=True)
    return RescaledClasses(divided(heights, temperature).log_softmax(-1), density, 1 / temperature)


def log_probabilities(density: Distribution) -> Float[Tensor, "*batch label"]:
    """Of every class, nats."""
    return density.log_prob(density.enumerate_support()).movedim(0, -1)


def divided(log_density: Tensor, temperature: Tensor) -> Tensor:
    """log p / T; -∞ stays, without a gradient."""
    ruled_out = log_density == -math.inf
    return torch.where(ruled_out, -math.inf, log_density.masked_fill(ruled_out, 0.0) / temperature)


class RescaledClasses(Categorical):
    """Classes whose log-probabilities are `slope` times those of another density, plus constants, normalised.

    Args:
        logits: of the classes, (*batch, label).
        density: the other one, whose Monte Carlo error follows.
        slope: a scalar, 1/T of a temperature.
    """

    def __init__(self, logits: Float[Tensor, "*batch label"], density: Distribution, slope: Tensor) -> None:
        self.density = density
        self.slope = slope
        super().__init__(logits=logits, validate_args=False)


@estimate.register
def _(density: RescaledClasses, value: Tensor) -> Estimate:
    """At most this error: of log q_k = a log p_k - log Σ_j p_j^a + constants, errors e_j of log p_j make the error
    a (e_k - Σ_j q_j e_j), and they may go together in any way: a ((1 - q_k) s_k + Σ_{j≠k} q_j s_j)."""
    log_prob = density.log_prob(value)
    with torch.no_grad():
        found = estimate(density.density, density.density.enumerate_support())
        share = density.probs.movedim(-1, 0)
        part = torch.where(found.standard_error == 0, 0.0, share * found.standard_error)
        own = torch.where(found.standard_error == 0, 0.0, (1 - share) * found.standard_error)
        error = density.slope.abs().to(log_prob) * (own + part.sum(0) - part)
        label = value.long().expand(log_prob.shape).unsqueeze(-1)

        def of_label(each: Tensor) -> Tensor:
            each = each.expand(share.shape).movedim(0, -1)
            return each.expand(*log_prob.shape, each.shape[-1]).gather(-1, label).squeeze(-1)

        told = [of_label(each) for each in (error, found.samples, found.unresolved)]
    return with_error(log_prob, *told)


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
            log_prob = self.density.log_prob(self.around(points))  # (points, *batch)
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
                    "its power with `framework.distributions.protocol.tempered.register`, or raise the temperature's "
                    "lower bound."
                )
        self.points = points
        self.log_normaliser = log_mean + math.log(2 * math.pi / points)

    @property
    def support(self) -> constraints.Constraint | None:
        return self.density.support

    @property
    def mode(self) -> Tensor:
        return self.density.mode

    def log_prob(self, value: Tensor) -> Tensor:
        return self.power_of(self.density.log_prob(value))

    def power_of(self, log_prob: Tensor) -> Tensor:
        """log_prob where that of p is `log_prob`."""
        # below the mode's, so that large log-densities do not cancel
        return divided(log_prob - self.top, self.temperature) - self.log_normaliser

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

    def around(self, points: int) -> Tensor:
        """Angles of the grid, (points, *batch, 1), the first at the mode."""
        turn = grid(points, dtype=self.start.dtype, device=self.start.device) + math.pi
        return self.start + turn.reshape(points, *(1,) * self.start.dim())


@slope.register
def _(density: CircularPower, value: Tensor) -> Slope | None:
    found = slope(density.density, value)
    if found is None:
        return None
    pull, stiffness = (part / density.temperature.to(part) for part in found[1:])
    return Slope(density.power_of(found.log_prob), pull, stiffness)


@estimate.register
def _(density: CircularPower, value: Tensor) -> Estimate:
    """At most this error: those of p and of its normaliser may be of the same draws, and add up."""
    found = estimate(density.density, value)
    log_prob = density.power_of(found.log_mean)
    with torch.no_grad():
        around = estimate(density.density, density.around(density.points)).standard_error
        of_normaliser = torch.where(around == 0, 0.0, density.powers.softmax(0) * around).sum(0)
        error = (found.standard_error + of_normaliser) / density.temperature.to(log_prob)
    return with_error(log_prob, error, found.samples, found.unresolved)


@images.register
def _(density: CircularPower, channels: Collection[str]) -> dict[str, Tensor]:
    return images(density.density, channels)  # drawn at the mode, which a power keeps


@peaks.register
def _(density: CircularPower) -> Tensor:
    return peaks(density.density)  # a power rises and falls with the density
