"""Densities raised to a power 1/T and normalised: broader than before for T > 1, narrower for T < 1."""

import logging
import math
from collections.abc import Collection
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular, grid, wrap
from framework.distributions.density import Mixture
from framework.distributions.description import CategoricalDensity, DerivedDensity
from framework.distributions.protocol import (
    Estimate,
    QuadraticBound,
    estimate,
    estimate_with_error,
    even_sample,
    images,
    mode_candidates,
    quadratic_bound,
    tempered_density,
)
from framework.errors import UserError

POINTS, MOST_POINTS = 1024, 2**15
"""First and largest number of points of the grid that normalises the power of a density of one angle.

The number is doubled until the grid resolves the power.
"""
RESOLVED = 1e-4
"""Largest difference between log ∫ p^(1/T) on a grid and on every second angle of this grid, nats.

If the difference is larger, the grid does not resolve the power.
"""
MASS_GAP = 0.01
"""Largest accepted |log ∫ p| on a grid, nats; if it is larger, a peak of p lies between the grid's angles."""
HELD = 0.3
"""Probability of the arc of a single angle of the grid, above which MASS_GAP does not apply.

Such an angle lies on the peak of p, so that the grid does not miss the peak. The grid is then too coarse for p itself,
but not necessarily for its power.
"""
NARROWEST = 3.0
"""Stretch s of the densest grid, in standard deviations of the power at its mode.

For a stretch s, half of the grid's angles lie within 2 atan(s) of the mode.
"""
QUANTILES = 2048
"""Number of angles, besides those of the grid, at which the distribution function is computed for random draws."""
BROADER = 0.25
"""Exponent B: the QUANTILES additional angles are quantiles of p^(B/T), so that tails and low peaks get angles too."""
_log = logging.getLogger(__name__)


def temper(density: Distribution, temperature: Float[Tensor, ""]) -> Distribution:
    """Return the density proportional to p^(1/T), with the shapes and the number type of p, and differentiable in T.

    T = 1 gives p itself, unless a gradient in T is wanted. A mixture over real numbers or angles is not raised to the
    power as a whole, but each of its components is.

    Args:
        density: p.
        temperature: T > 0, a scalar.

    Raises:
        ValueError: T is not above 0, or not finite.
        UserError: no power of such a density is known; the message says how to register it.
    """
    if torch.compiler.is_exporting():  # a trace depends on no value
        return tempered_density(density, temperature)
    value = float(temperature.detach())
    if not 0 < value < math.inf:
        raise ValueError(f"Got temperature = {value}; expected a finite number above 0.")
    if value == 1 and not temperature.requires_grad:
        return density
    return tempered_density(density, temperature)


@tempered_density.register(Distribution)
def _(density: Distribution, temperature: Tensor) -> Distribution:
    if density.has_enumerate_support and density.event_shape == ():
        return tempered_classes(density, temperature)
    support = density.support if tuple(density.event_shape) == (1,) else None
    if isinstance(support, Circular) and support.ranges is None:
        return CircularPower(density, temperature)
    raise UserError(
        f"The temperature of {type(density).__name__} over {tuple(density.event_shape)} numbers cannot be changed, "
        "because the framework does not know how to normalise p^(1/T). Register a function that returns this "
        "density with `framework.distributions.protocol.tempered_density.register`, or leave out the wrapper that "
        "changes the temperature."
    )


@tempered_density.register
def _(density: Mixture, temperature: Tensor) -> Distribution:
    """Return the tempered mixture: over classes it is tempered as a whole, otherwise component by component.

    Tempering a component keeps its weight w_k. The power of a sum Σ w_k p_k over real numbers or angles has no
    normaliser in closed form. The mixture of the tempered components is normalised, since each component is. This
    mixture equals p at T = 1, and is exact for one component. Modes that different components describe remain separate.
    """
    if density.has_enumerate_support:
        return tempered_classes(density, temperature)
    tempered = Mixture(density.log_weights, tempered_density(density.components, temperature))
    tempered.over_models = density.over_models
    return tempered


def tempered_classes(density: Distribution, temperature: Tensor) -> "RescaledClasses":
    """Return p_k^(1/T) / Σ_j p_j^(1/T) for a density over classes k with probabilities p_k: logits divided by T.

    Source: Guo et al. 2017, eq. 9. The density may be of any type.
    """
    log_prob = log_probabilities(density)
    # subtract the largest first, so that differences and not sizes are rounded; a probability of 0 stays 0
    heights = log_prob - log_prob.amax(-1, keepdim=True)
    return RescaledClasses(
        divide_by_temperature(heights, temperature).log_softmax(-1), density, 1 / temperature
    )


def log_probabilities(density: Distribution) -> Float[Tensor, "*batch label"]:
    """Return the log-probability of every class, nats."""
    return density.log_prob(density.enumerate_support()).movedim(0, -1)


def divide_by_temperature(log_density: Tensor, temperature: Tensor) -> Tensor:
    """Return log p / T; -∞ stays -∞, without a gradient."""
    ruled_out = log_density == -math.inf
    return torch.where(ruled_out, -math.inf, log_density.masked_fill(ruled_out, 0.0) / temperature)


class RescaledClasses(CategoricalDensity):
    """A density over classes with the logits a log p_k + b_k, for the probabilities p_k of another density.

    The slope a is a number, 1/T for a temperature T. The biases b_k of the classes are constants, 0 for a temperature.

    Args:
        logits: log-probabilities of this density, up to a constant per item of the batch, (*batch, label).
        density: the other density, whose Monte Carlo error gives the error of this density.
        slope: a, a scalar.
    """

    def __init__(self, logits: Float[Tensor, "*batch label"], density: Distribution, slope: Tensor) -> None:
        self.density = density
        self.slope = slope
        super().__init__(logits=logits, validate_args=False)


@estimate.register
def _(density: RescaledClasses, value: Tensor) -> Estimate:
    """Return the log-probability of the classes `value`, with an upper bound of its Monte Carlo error.

    Let p_k be the probabilities of the other density, s_k the standard errors of their logarithms, and q_k the
    probabilities of this density: log q_k = a log p_k + b_k - log Σ_j exp(a log p_j + b_j) with the slope a and the
    biases b_k. Errors e_j of log p_j cause the error a (e_k - Σ_j q_j e_j) of log q_k. The errors may be correlated in
    any way, so the bound is a ((1 - q_k) s_k + Σ_{j≠k} q_j s_j).
    """
    log_prob = density.log_prob(value)
    with torch.no_grad():
        inner_estimate = estimate(density.density, density.density.enumerate_support())
        share = density.probs.movedim(-1, 0)
        part = torch.where(inner_estimate.standard_error == 0, 0.0, share * inner_estimate.standard_error)
        own = torch.where(
            inner_estimate.standard_error == 0, 0.0, (1 - share) * inner_estimate.standard_error
        )
        error = density.slope.abs().to(log_prob) * (own + part.sum(0) - part)
        label = value.long().expand(log_prob.shape).unsqueeze(-1)

        def of_label(field: Tensor) -> Tensor:
            field = field.expand(share.shape).movedim(0, -1)
            return field.expand(*log_prob.shape, field.shape[-1]).gather(-1, label).squeeze(-1)

        fields = [of_label(field) for field in (error, inner_estimate.samples, inner_estimate.unresolved)]
    return estimate_with_error(log_prob, *fields)


class CircularPower(DerivedDensity):
    """The density p^(1/T) / Z for a density p of one angle; Z is computed by the trapezium rule on a grid.

    The grid starts at the mode, so that no peak is missed there. It is refined until it resolves the power, and until
    the integral of p over it is about 1. A power that is too narrow for MOST_POINTS equally spaced angles gets a
    stretched grid, which is denser about the mode: the angles mode + 2 atan(s tan(u/2)) for equally spaced u and a
    stretch s. The trapezium rule is spectrally exact on these angles too.

    Samples are drawn by the inverse of the distribution function. This function is computed at the angles of the grid
    and at QUANTILES quantiles of p^(BROADER/T), and the density is taken as linear between these angles.
    Neighbouring angles are 0.005 standard deviations of a peak apart at its highest point, and 0.4 standard deviations
    apart at a distance of six standard deviations from this point.

    Args:
        density: p, event_shape (1,), over the whole circle.
        temperature: T.

    Raises:
        UserError: the power is too narrow for the finest grid.
    """

    def __init__(self, density: Distribution, temperature: Tensor) -> None:
        super().__init__(density)
        self.temperature = temperature
        self.start = density.mode.detach() if density.batch_shape.numel() else density.sample()
        self.stretch = torch.ones_like(self.start, dtype=torch.float64)
        self.points = POINTS
        off = self._fill()
        while bool((off > RESOLVED).any()):  # false for NaN, which no grid resolves; log_prob is NaN then
            if self.points < MOST_POINTS:
                self.points *= 2
            elif bool((self.stretch == 1).all()) and bool((self._narrow() < 1).any()):
                self.points, self.stretch = POINTS, self._narrow()
            else:
                raise UserError(
                    f"{type(density).__name__} at temperature {float(temperature.detach()):g} is too narrow for a grid "
                    f"of {MOST_POINTS} angles (the log of its mass has an error of {off.max().item():.2g}). Raise "
                    "the lower bound of the temperature, or register a function that returns the tempered density with "
                    "`framework.distributions.protocol.tempered_density.register`."
                )
            off = self._fill()

    def _fill(self) -> Float[Tensor, "*batch"]:
        """Evaluate the power p^(1/T) and its normaliser Z on the grid.

        Return the error of log Z, nats; it is infinite where the grid misses a peak, unless it is the finest grid.
        """
        self.angles, log_width = self._grid(self.points)
        log_prob = self.density.log_prob(self.angles)  # (points, *batch)
        self.top = log_prob[0]
        self.powers = divide_by_temperature(log_prob - self.top, self.temperature)
        self.log_width = log_width.to(log_prob.dtype)
        terms = self.powers + self.log_width
        self.log_normaliser, coarse = (terms[::every].logsumexp(0) + math.log(every) for every in (1, 2))
        off = (self.log_normaliser - coarse).detach().abs()
        mass = log_prob.detach() + self.log_width
        total = mass.logsumexp(0)
        missed = (total.abs() > MASS_GAP) & (mass.amax(0) < math.log(HELD))
        if not bool(missed.any()):
            return off
        if self.points == MOST_POINTS:
            _log.warning(
                "%d of %d densities (%s) have a mass between %.3g and %.3g on a grid of %d angles, not 1. Either "
                "log_prob is not normalised, or these densities have a peak narrower than the grid; their powers "
                "then lack this peak.",
                int(missed.sum()), missed.numel(), type(self.density).__name__,
                total[missed].amin().exp().item(), total[missed].amax().exp().item(), self.points,
            )  # fmt: skip
            return off
        return torch.where(missed, math.inf, off)

    def _grid(self, points: int) -> tuple[Tensor, Tensor]:
        """Return the grid's angles, (points, *batch, 1), and the logarithm of the arc length of each, (points, *batch).

        The arcs are the parts of the circle that the angles represent. The first angle is the mode.
        """
        u = grid(points, dtype=torch.float64, device=self.start.device) + math.pi
        return self._angles_at(u.reshape(points, *(1,) * self.start.dim()), 2 * math.pi / points)

    def _angles_at(self, u: Float[Tensor, "number *batch 1"], step: float) -> tuple[Tensor, Tensor]:
        """Return the angles θ = mode + 2 atan(s tan(u/2)) of the stretched grid, and the logarithms of arc lengths.

        The arc length of an angle is dθ/du · step; s is the stretch of the grid.

        Args:
            u: equally spaced numbers.
            step: distance between neighbouring numbers in `u`.
        """
        half_sine, half_cosine = (u / 2).sin(), (u / 2).cos()
        offset = 2 * torch.atan2(self.stretch * half_sine, half_cosine)
        arc = self.stretch / (half_cosine.square() + (self.stretch * half_sine).square())
        angle = (self.start.double() + offset).to(self.start.dtype)
        return angle, (arc.log() + math.log(step)).squeeze(-1).expand(angle.shape[:-1])

    def _narrow(self) -> Float[Tensor, "*batch 1"]:
        """Return the stretch s of the grid, at most 1: the grid's spacing at the mode, divided by its mean spacing."""
        # width of the normal density with the same height; p^(1/T) is √T times as wide
        width = (-self.density.log_prob(self.start).detach().double()).exp() / math.sqrt(2 * math.pi)
        width = width * self.temperature.detach().double().sqrt()
        return (NARROWEST * width).nan_to_num(nan=1.0).clamp(1e-12, 1).unsqueeze(-1)

    @property
    def mode(self) -> Tensor:
        return self.density.mode

    def log_prob(self, value: Tensor) -> Tensor:
        return self.power_of(self.density.log_prob(value))

    def power_of(self, log_prob: Tensor) -> Tensor:
        """Return the log-density of the power p^(1/T) / Z, given the log-density `log_prob` of p."""
        # relative to the mode's log-density, so that large log-densities do not cancel
        return divide_by_temperature(log_prob - self.top, self.temperature) - self.log_normaliser

    @property
    def mass(self) -> Float[Tensor, "points *batch"]:
        """Probability of the arc that each angle of the grid represents."""
        return (self.powers + self.log_width).softmax(0)

    @torch.no_grad()
    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape)
        shares = torch.rand(shape.numel(), *self.batch_shape, dtype=torch.float64, device=self.start.device)
        return self.quantiles(shares).reshape(*shape, *self.batch_shape, 1)

    @torch.no_grad()
    def quantiles(self, shares: Float[Tensor, "number *batch"]) -> Float[Tensor, "number *batch 1"]:
        """Return the angles up to which the arc from the mode has the probabilities `shares`, float64 in [0, 1)."""
        offset, height = self._between
        until = _cumulative_integral(offset, height)
        flat = shares.reshape(len(shares), len(until)).T.contiguous() * until[:, -1:]
        cell = torch.searchsorted(until, flat, right=True).clamp(1, until.shape[-1] - 1)
        low, high, start, end = (
            column.gather(-1, at) for column in (height, offset) for at in (cell - 1, cell)
        )
        rest = (flat - until.gather(-1, cell - 1)).clamp(min=0)
        # the density rises from low to high across the cell: low t + slope t²/2 = rest
        width = (end - start).clamp(min=1e-300)
        root = (low.square() + 2 * (high - low) / width * rest).clamp(min=0).sqrt()
        step = (2 * rest / (low + root).clamp(min=1e-300)).clamp(max=width)
        angles = wrap(self.start.double() + (start + step).T.reshape(len(shares), *self.batch_shape, 1))
        return angles.to(self.start.dtype)

    @cached_property
    @torch.no_grad()
    def _between(self) -> tuple[Float[Tensor, "item node"], Float[Tensor, "item node"]]:
        """Ascending angles relative to the mode, from 0 to 2π, and p^(1/T) at these angles, scaled to 1 at the mode."""
        batch = self.batch_shape.numel()
        u = (
            2
            * math.pi
            * torch.arange(self.points + 1, dtype=torch.float64, device=self.start.device)
            / self.points
        )
        broad = (
            (BROADER * self.powers.double() + self.log_width.double())
            .softmax(0)
            .reshape(self.points, batch)
            .T
        )
        until = _cumulative_integral(u, torch.cat([broad, broad[:, :1]], -1))
        share = torch.linspace(0, 1, QUANTILES + 1, dtype=torch.float64, device=u.device)[:-1] * until[:, -1:]
        cell = torch.searchsorted(until, share.contiguous(), right=True).clamp(1, self.points)
        below, mass = until.gather(-1, cell - 1), until.gather(-1, cell) - until.gather(-1, cell - 1)
        quantile = u[1] * (cell - 1 + ((share - below) / mass.clamp(min=1e-300)).clamp(0, 1))
        whole = torch.cat([u.expand(batch, -1), quantile], -1).sort(-1).values
        angle, _ = self._angles_at(whole.T.reshape(whole.shape[-1], *self.batch_shape, 1), 1.0)
        # the rounded angles that the density was evaluated at, not the exact ones
        offset = (angle.double() - self.start.double()).clamp(0, 2 * math.pi)
        offset[0], offset[-1] = 0.0, 2 * math.pi
        height = divide_by_temperature(
            self.density.log_prob(angle).double() - self.top.double(), self.temperature
        ).exp()
        offset, height = (
            column.reshape(whole.shape[-1], batch).T.contiguous() for column in (offset, height)
        )
        return offset, height

    def entropy(self) -> Tensor:
        """Return the entropy of p^(1/T) / Z, nats: log Z minus the mean of log p^(1/T), by the trapezium rule."""
        # p log p → 0 as p → 0; the clamp keeps 0 · (-inf) from being NaN
        return self.log_normaliser - (self.mass * self.powers.clamp(min=-1e4)).sum(0)


def _cumulative_integral(position: Tensor, height: Float[Tensor, "item node"]) -> Float[Tensor, "item node"]:
    """Return the integral of `height` from the first position to each position, by the trapezium rule.

    Args:
        position: ascending positions, (node,) if they are the same for all items, otherwise (item, node).
        height: values of the integrand at the positions.
    """
    cells = position.diff(dim=-1) * (height[:, 1:] + height[:, :-1]) / 2
    return torch.nn.functional.pad(cells.cumsum(-1), (1, 0))


@even_sample.register
def _(density: CircularPower, count: int) -> Tensor:
    """Return quantiles for equally spaced probabilities, from a random probability on."""
    start = torch.rand(density.batch_shape, dtype=torch.float64, device=density.start.device)
    number = torch.arange(count, dtype=torch.float64, device=start.device).reshape(-1, *(1,) * start.dim())
    return density.quantiles((number + start) / count)


@quadratic_bound.register
def _(density: CircularPower, value: Tensor) -> QuadraticBound | None:
    bound = quadratic_bound(density.density, value)
    if bound is None:
        return None
    pull, stiffness = (part / density.temperature.to(part) for part in bound[1:])
    return QuadraticBound(density.power_of(bound.log_prob), pull, stiffness)


@estimate.register
def _(density: CircularPower, value: Tensor) -> Estimate:
    """Return the log-density of the power at `value`, with an upper bound of its Monte Carlo error.

    The errors of log p at `value` and of the normaliser log Z may come from the same draws, so they are added.
    """
    inner_estimate = estimate(density.density, value)
    log_prob = density.power_of(inner_estimate.log_mean)
    with torch.no_grad():
        around = estimate(density.density, density.angles).standard_error
        of_normaliser = torch.where(around == 0, 0.0, density.mass * around).sum(0)
        error = (inner_estimate.standard_error + of_normaliser) / density.temperature.to(log_prob)
    return estimate_with_error(log_prob, error, inner_estimate.samples, inner_estimate.unresolved)


@images.register
def _(density: CircularPower, channels: Collection[str]) -> dict[str, Tensor]:
    return images(density.density, channels)  # they show the mode, which a power does not change


@mode_candidates.register
def _(density: CircularPower) -> Tensor:
    return mode_candidates(density.density)  # a power rises and falls where the density does
