"""Densities that no method owns: the mixture, and marginals, medians and quadratures of any density."""

import math
from functools import singledispatch
from typing import ClassVar

import torch
from torch import Tensor
from torch.distributions import (
    Categorical,
    Distribution,
    Independent,
    MultivariateNormal,
    Normal,
    constraints,
)

from framework.distributions.circular import circular_median, grid
from framework.errors import UserError

CHUNK = 2**20
"""Component densities evaluated at once without gradient, when one density is asked at many points."""


class Mixture(Distribution):
    """Σ_k w_k p_k: every wrapper and mixture head returns this; parameters are never averaged.

    Args:
        log_weights: (*batch, K), nats; normalised here, so logits will do. -inf is a weight of zero.
        components: one density with batch_shape (*batch, K).

    A mixture of one is its component to the last bit: the log-weight of one component is exactly 0 and log-sum-exp
    of one term is that term.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}
    has_rsample = False

    def __init__(self, log_weights: Tensor, components: Distribution) -> None:
        if log_weights.shape != components.batch_shape:
            raise ValueError(
                f"log_weights of shape {tuple(log_weights.shape)} do not fit components with batch_shape "
                f"{tuple(components.batch_shape)}; wanted the same shape, the last dimension the components."
            )
        self.log_weights = torch.log_softmax(log_weights, -1)
        self.components = components
        self.has_enumerate_support = components.has_enumerate_support
        super().__init__(components.batch_shape[:-1], components.event_shape, validate_args=False)

    @property
    def support(self) -> constraints.Constraint | None:
        return self.components.support

    def enumerate_support(self, expand: bool = True) -> Tensor:
        """Every class, (class, *batch) or (class, *1) without `expand`."""
        return self.components.enumerate_support(expand)[..., 0]

    def log_prob(self, value: Tensor) -> Tensor:
        extra = value.dim() - len(self.batch_shape) - len(self.event_shape)
        rows = max(1, CHUNK // max(1, self.log_weights.numel()))
        if extra > 0 and value.shape[0] > rows and not torch.is_grad_enabled():
            # a grid of angles on many samples of many components would fill the memory
            return torch.cat([self.log_prob(part) for part in value.split(rows)])
        spread = value.unsqueeze(-1 - len(self.event_shape))
        return torch.logsumexp(self.log_weights + self.components.log_prob(spread), -1)

    @torch.no_grad()
    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape)
        if self.log_weights.shape[-1] == 1:
            return self.components.sample(shape).squeeze(-1 - len(self.event_shape))
        which = self._which(shape)
        return pick(self.components, which).sample()

    def _which(self, shape: torch.Size) -> Tensor:
        whole = shape + self.batch_shape
        if whole.numel() == 0:  # torch.multinomial refuses to draw nothing
            return torch.zeros(whole, dtype=torch.int64, device=self.log_weights.device)
        weights = self.log_weights.exp().reshape(-1, self.log_weights.shape[-1])
        return torch.multinomial(weights, shape.numel(), replacement=True).T.reshape(whole)

    @property
    def mode(self) -> Tensor:
        """The likeliest class; or the component mode at which the density is highest (exact where they are apart)."""
        if self.has_enumerate_support:
            support = self.enumerate_support()
            return support.gather(0, self.log_prob(support).argmax(0, keepdim=True)).squeeze(0)
        modes = self.components.mode.movedim(-1 - len(self.event_shape), 0)  # (K, *batch, *event)
        best = self.log_prob(modes).argmax(0)
        index = best.reshape(1, *best.shape, *(1,) * len(self.event_shape))
        return modes.gather(0, index.expand(1, *best.shape, *self.event_shape)).squeeze(0)

    def entropy(self) -> Tensor:
        """Nats. Exact for classes, by quadrature for one angle.

        Otherwise the mean of -log_prob over about 1000 samples in all, as many of each component, so that only their
        spread within components is left to chance.
        """
        count = self.log_weights.shape[-1]
        if count == 1:
            return self.components.entropy().squeeze(-1)
        if self.event_shape == (1,) and isinstance(self.support, Circular):
            return circular_entropy(self)
        if self.has_enumerate_support:
            log_prob = self.log_prob(self.enumerate_support())
            return -(log_prob.exp() * log_prob.clamp(min=-1e4)).sum(0)
        each = max(2, 1024 // count)
        drawn = self.components.sample(torch.Size((each,)))
        values = drawn.movedim(-1 - len(self.event_shape), 1).flatten(0, 1)
        surprise = -self.log_prob(values).unflatten(0, (each, count)).mean(0).movedim(0, -1)
        return (self.log_weights.exp() * surprise).sum(-1)


class Circular(constraints.Constraint):
    """Real numbers read as angles, radians modulo 2π, in the last dimension.

    Args:
        ranges: (lowest, highest) of each angle within [-π, π], radians, of a density that is spread over a chart of
            something else (rotations, say) and integrates to 1 there; None for a whole turn of each.
    """

    event_dim = 1

    def __init__(self, ranges: tuple[tuple[float, float], ...] | None = None) -> None:
        self.ranges = ranges
        super().__init__()

    def check(self, value: Tensor) -> Tensor:
        return value.isfinite().all(-1)


circular = Circular()
"""The support of a density over angles, each a whole turn."""


@singledispatch
def pick(density: Distribution, index: Tensor) -> Distribution:
    """Of a density with batch_shape (*batch, K) the one at `index` (*sample, *batch) of the last batch dimension.

    A density with parameters registers its own, which gathers them: `@pick.register`. Without it everything is drawn
    and all but one of K draws thrown away.
    """
    return _Picked(density, index)


class _Picked(Distribution):
    """Samples of one component each, by drawing all."""

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    def __init__(self, density: Distribution, index: Tensor) -> None:
        self.density = density
        self.index = index
        super().__init__(index.shape, density.event_shape, validate_args=False)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        lead = self.index.shape[: self.index.dim() - len(self.density.batch_shape) + 1]
        drawn = self.density.sample(torch.Size(sample_shape) + lead)  # (*sample, *lead, *batch, K, *event)
        index = self.index.expand((*sample_shape, *self.index.shape))
        axis = index.dim()
        index = index.reshape(*index.shape, 1, *(1,) * len(self.event_shape))
        return drawn.gather(axis, index.expand((*index.shape[: axis + 1], *self.event_shape))).squeeze(axis)


@pick.register
def _(density: Categorical, index: Tensor) -> Distribution:
    return Categorical(logits=take(density.logits, index), validate_args=False)


@pick.register
def _(density: Independent, index: Tensor) -> Distribution:
    base = density.base_dist
    if not isinstance(base, Normal) or density.reinterpreted_batch_ndims != 1:
        return _Picked(density, index)
    loc, scale = (take(parameter, index) for parameter in (base.loc, base.scale))
    return Independent(Normal(loc, scale, validate_args=False), 1, validate_args=False)


def take(parameter: Tensor, index: Tensor) -> Tensor:
    """`parameter` (*batch, K, number) at `index` (*sample, *batch) of K: (*sample, *batch, number)."""
    lead = index.shape[: index.dim() - parameter.dim() + 2]
    wide = parameter.expand((*lead, *parameter.shape))
    return wide.gather(-2, index[..., None, None].expand(*index.shape, 1, parameter.shape[-1])).squeeze(-2)


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
        "Register one with `framework.distributions.density.marginal.register`, or leave out the "
        "metric or picture that needs it."
    )


@marginal.register
def _(density: Mixture, index: int) -> Distribution:
    return Mixture(density.log_weights, marginal(density.components, index))


@marginal.register
def _(density: Independent, index: int) -> Distribution:
    if density.event_shape == (1,) and index == 0:
        return density
    if not isinstance(density.base_dist, Normal):
        raise UserError(f"No marginal is known for Independent({type(density.base_dist).__name__}).")
    here = slice(index, index + 1)
    base = Normal(density.base_dist.loc[..., here], density.base_dist.scale[..., here], validate_args=False)
    return Independent(base, 1, validate_args=False)


@marginal.register
def _(density: MultivariateNormal, index: int) -> MultivariateNormal:
    if density.event_shape == (1,) and index == 0:
        return density
    here = slice(index, index + 1)
    scale = density.variance[..., here].sqrt().unsqueeze(-1)
    return MultivariateNormal(density.loc[..., here], scale_tril=scale, validate_args=False)


@singledispatch
def median(density: Distribution, samples: int) -> Tensor:
    """The point of least expected absolute deviation, number by number (eq. 3.23), from `samples` draws (3.24).

    A density that knows it in closed form registers its own: `@median.register`, and draws nothing.
    """
    if density.has_enumerate_support:
        return density.mode  # of classes: a label is right or wrong, and nothing lies between
    drawn = density.sample(torch.Size((samples,)))
    if isinstance(density.support, Circular):
        return circular_median(drawn)
    return drawn.median(0).values


@median.register
def _(density: MultivariateNormal, samples: int) -> Tensor:
    # each number's marginal is symmetric about its mean
    return density.loc


def circular_grid(density: Distribution, points: int = 360) -> tuple[Tensor, Tensor]:
    """Angles (points,) in [-π, π) and the log-density there (points, *batch) of a density of one angle.

    A density narrower than the grid (concentration above points²/40) may fall between two points; use more points
    for those.
    """
    if tuple(density.event_shape) != (1,):
        raise ValueError(
            f"wanted the density of one angle, got event_shape {tuple(density.event_shape)}; use marginal()."
        )
    # a sample of nothing tells the density's dtype and device
    like = density.sample(torch.Size((0,)))
    angles = grid(points, dtype=like.dtype, device=like.device)
    value = angles.reshape(points, *(1,) * len(density.batch_shape), 1).expand(
        points, *density.batch_shape, 1
    )
    return angles, density.log_prob(value)


def circular_entropy(density: Distribution, points: int = 720) -> Tensor:
    """Entropy of a density of one angle, nats, by the trapezium rule (spectrally exact for smooth densities)."""
    _, log_density = circular_grid(density, points)
    mass = log_density.exp() * (2 * math.pi / points)
    return -(mass * log_density.clamp(min=-1e4)).sum(0) / mass.sum(0)
