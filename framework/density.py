"""Densities that no method owns: the mixture, and marginals, medians and quadratures of any density."""

import math
from functools import singledispatch

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal, constraints

from framework.circular import circular_median, grid
from framework.errors import UserError


class Mixture(Distribution):
    """Σ_k w_k p_k: every wrapper and mixture head returns this; parameters are never averaged.

    Args:
        log_weights: (*batch, K), nats; normalised here, so logits will do. -inf is a weight of zero.
        components: one density with batch_shape (*batch, K).

    A mixture of one is its component to the last bit: the log-weight of one component is exactly 0 and log-sum-exp
    of one term is that term.
    """

    arg_constraints = {}
    has_rsample = False

    def __init__(self, log_weights: Tensor, components: Distribution) -> None:
        if log_weights.shape != components.batch_shape:
            raise ValueError(
                f"log_weights of shape {tuple(log_weights.shape)} do not fit components with batch_shape "
                f"{tuple(components.batch_shape)}; wanted the same shape, the last dimension the components."
            )
        self.log_weights = torch.log_softmax(log_weights, -1)
        self.components = components
        super().__init__(components.batch_shape[:-1], components.event_shape, validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        return self.components.support

    def log_prob(self, value: Tensor) -> Tensor:
        spread = value.unsqueeze(-1 - len(self.event_shape))
        return torch.logsumexp(self.log_weights + self.components.log_prob(spread), -1)

    @torch.no_grad()
    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape)
        drawn = self.components.sample(shape)  # (*sample, *batch, K, *event)
        which = torch.distributions.Categorical(logits=self.log_weights, validate_args=False).sample(shape)
        index = which.reshape(*which.shape, 1, *(1,) * len(self.event_shape))
        axis = which.dim()
        return drawn.gather(axis, index.expand(*which.shape, 1, *self.event_shape)).squeeze(axis)

    @property
    def mode(self) -> Tensor:
        """The component mode at which the mixture's density is highest (exact for separated components)."""
        modes = self.components.mode.movedim(-1 - len(self.event_shape), 0)  # (K, *batch, *event)
        best = self.log_prob(modes).argmax(0)
        index = best.reshape(1, *best.shape, *(1,) * len(self.event_shape))
        return modes.gather(0, index.expand(1, *best.shape, *self.event_shape)).squeeze(0)

    def entropy(self) -> Tensor:
        """Nats. Of one angle by quadrature; otherwise the mean of -log_prob over 256 samples a component."""
        if self.log_weights.shape[-1] == 1:
            return self.components.entropy().squeeze(-1)
        if self.event_shape == (1,) and self.support is circular:
            return circular_entropy(self)
        drawn = self.components.sample(torch.Size((256,)))
        values = drawn.movedim(-1 - len(self.event_shape), 1).flatten(0, 1)
        surprise = -self.log_prob(values).unflatten(0, (256, -1)).mean(0).movedim(0, -1)
        return (self.log_weights.exp() * surprise).sum(-1)


class _Circular(constraints.Constraint):
    """Real numbers read as angles, radians modulo 2π, in the last dimension."""

    event_dim = 1

    def check(self, value: Tensor) -> Tensor:
        return value.isfinite().all(-1)


circular = _Circular()
"""The support of a density over angles."""


@singledispatch
def marginal(density: Distribution, index: int) -> Distribution:
    """The density of number `index` of the target alone; keeps an event dimension of one.

    A density over several numbers registers its own: `@marginal.register`.

    Raises:
        UserError: the density has not said how.
    """
    if density.event_shape == (1,) and index == 0:
        return density
    raise UserError(
        f"{type(density).__name__} has no marginal for one of its {tuple(density.event_shape)} numbers. "
        "Register one with `framework.density.marginal.register`, or leave out the metric or picture that needs it."
    )


@marginal.register
def _(density: Mixture, index: int) -> Distribution:
    return Mixture(density.log_weights, marginal(density.components, index))


@marginal.register
def _(density: Independent, index: int) -> Distribution:
    if not isinstance(density.base_dist, Normal):
        raise UserError(f"No marginal is known for Independent({type(density.base_dist).__name__}).")
    here = slice(index, index + 1)
    base = Normal(density.base_dist.loc[..., here], density.base_dist.scale[..., here], validate_args=False)
    return Independent(base, 1, validate_args=False)


@singledispatch
def median(density: Distribution, samples: int) -> Tensor:
    """The point of least expected absolute deviation, number by number (eq. 3.23), from `samples` draws (3.24).

    A density that knows it in closed form registers its own: `@median.register`, and draws nothing.
    """
    drawn = density.sample(torch.Size((samples,)))
    if density.support is circular:
        return circular_median(drawn)
    return drawn.median(0).values


def circular_grid(density: Distribution, points: int = 720) -> tuple[Tensor, Tensor]:
    """Angles (points,) in [-π, π) and the log-density there (points, *batch) of a density of one angle.

    Each value is averaged over nothing: a density narrower than the grid (concentration above points²/40) may fall
    between two points; use more points for those.
    """
    if tuple(density.event_shape) != (1,):
        raise ValueError(f"wanted the density of one angle, got event_shape {tuple(density.event_shape)}; use marginal().")
    angles = grid(points)
    value = angles.reshape(points, *(1,) * len(density.batch_shape), 1).expand(points, *density.batch_shape, 1)
    return angles, density.log_prob(value)


def circular_entropy(density: Distribution, points: int = 4096) -> Tensor:
    """Entropy of a density of one angle, nats, by the trapezium rule (spectrally exact for smooth densities)."""
    _, log_density = circular_grid(density, points)
    mass = log_density.exp() * (2 * math.pi / points)
    return -(mass * log_density.clamp(min=-1e4)).sum(0) / mass.sum(0)
