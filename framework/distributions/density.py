"""`Mixture`, the density that every ensemble and mixture head returns, and a grid for densities of one angle."""

import math
from collections.abc import Collection, Mapping, Sequence

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.distributions import protocol
from framework.distributions.batch_shapes import Reshaped
from framework.distributions.circular import Circular, circular, grid
from framework.distributions.description import PlainDensity
from framework.distributions.highest import crossings, highest
from framework.distributions.many_components import FEWEST, likeliest_modes
from framework.distributions.medians import median_of_real
from framework.distributions.panels import entropy_of_one, has_range
from framework.distributions.picked import PickedMixture

__all__ = [
    "CHUNK",
    "Circular",
    "Mixture",
    "circular",
    "circular_entropy",
    "circular_grid",
    "estimate_of_sum",
]  # some of these are defined in other files now; the old import path keeps working

circular_entropy = entropy_of_one
CHUNK = 2**20
"""Largest number of component densities that are evaluated at once, if no gradient is needed."""
LARGEST = 2**26
"""Largest number of elements of all values at which component densities are evaluated at once.

A value that is an image has about 1e5 elements.
"""

SHORT, MANY = 16, 4096
"""Largest number of components, and smallest number of weights, for which torch's log_softmax is not used.

Weights are then normalised by simpler operations, which take less time for many short rows of weights.
"""

CROSSED = 16
"""Largest number of components with which the search for the mode also starts between every pair (`crossings`)."""


class Mixture(PlainDensity):
    """The density Σ_k w_k p_k with weights w_k and components p_k, which every ensemble and mixture head returns.

    The densities are averaged, never their parameters. A mixture of one component equals this component to the last
    bit: the log-weight of one component is exactly 0, and log-sum-exp of one term is that term.

    Args:
        log_weights: (*batch, K), nats. They are normalised here, so logits are accepted. -inf is a weight of zero.
        components: one density with batch_shape (*batch, K).

    Attributes:
        over_models: True if the components are the predictions of several models, or of one model with several weights,
            as wrappers return them; False if they are parts of the density of one model.
    """

    over_models = False

    def __init__(self, log_weights: Tensor, components: Distribution) -> None:
        if log_weights.shape != components.batch_shape:
            raise ValueError(
                f"log_weights of shape {tuple(log_weights.shape)} do not fit components with batch_shape "
                f"{tuple(components.batch_shape)}; expected the same shape, with the components in the last dimension."
            )
        self.log_weights = _log_shares(log_weights)
        self.components = components
        self.has_enumerate_support = components.has_enumerate_support
        super().__init__(components.batch_shape[:-1], components.event_shape, validate_args=False)

    @property
    def support(self) -> constraints.Constraint | None:
        return self.components.support

    def enumerate_support(self, expand: bool = True) -> Tensor:
        """Return every class, (class, *batch); without `expand`, all dimensions after the first have length 1."""
        return self.components.enumerate_support(expand)[..., 0]

    def log_prob(self, value: Tensor) -> Tensor:
        parts = self.split_values(value)
        if len(parts) > 1:
            return torch.cat([self.log_prob(part) for part in parts])
        spread = value.unsqueeze(-1 - len(self.event_shape))
        return torch.logsumexp(self.log_weights + self.components.log_prob(spread), -1)

    def split_values(self, value: Tensor) -> Sequence[Tensor]:
        """Return `value` (*sample, *batch, *event) in pieces along the first dimension that fit into memory.

        For example, a grid of angles with many samples and many components must be split. While gradients are recorded
        or a program is exported, nothing is split, and the only piece is `value`.
        """
        extra = value.dim() - len(self.batch_shape) - len(self.event_shape)
        if (
            torch.is_grad_enabled() or torch.compiler.is_exporting()
        ):  # a program must not depend on the batch size
            return [value]
        if extra > 0 and value.shape[0] > self.rows:
            return value.split(self.rows)
        return [value]

    @property
    def rows(self) -> int:
        """Largest length of the first dimension of values that are evaluated at once, if no gradient is needed."""
        components = max(1, self.log_weights.numel())
        return max(1, min(CHUNK // components, LARGEST // (components * max(1, self.event_shape.numel()))))

    @torch.no_grad()
    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape)
        if self.log_weights.shape[-1] == 1:
            return self.components.sample(shape).squeeze(-1 - len(self.event_shape))
        which = self._which(shape)
        return protocol.pick(self.components, which).sample()

    def _which(self, shape: torch.Size) -> Tensor:
        whole = shape + self.batch_shape
        if whole.numel() == 0:  # torch.multinomial refuses to draw nothing
            return torch.zeros(whole, dtype=torch.int64, device=self.log_weights.device)
        weights = self.log_weights.exp().reshape(-1, self.log_weights.shape[-1])
        return torch.multinomial(weights, shape.numel(), replacement=True).T.reshape(whole)

    @property
    def mode(self) -> Tensor:
        """Mode: the most likely class, the mode of a single component, or else a maximum that `highest` finds.

        With `many_components.FEWEST` or more components over one number, the search starts only from the modes that
        `likeliest_modes` returns. If that function returns None, the search starts from all `mode_candidates`.
        """
        event = len(self.event_shape)
        if self.log_weights.shape[-1] == 1:
            return self.components.mode.squeeze(-1 - event)
        if self.has_enumerate_support:
            support = self.enumerate_support()
            return support.gather(0, self.log_prob(support).argmax(0, keepdim=True)).squeeze(0)
        # take the candidates of every component, also of nested mixtures: a lower peak of one component may become
        # the highest point together with a peak of another component
        starts = protocol.mode_candidates(self)
        if self.event_shape.numel() > 1 and self.log_weights.shape[-1] <= CROSSED:
            modes = self.components.mode.movedim(-1 - event, 0)  # (K, *batch, *event)
            starts = torch.cat([starts, crossings(self.components, modes)])
        count = self.log_weights.shape[-1]
        if self.event_shape.numel() == 1 and len(starts) == count >= FEWEST:
            chosen = likeliest_modes(self.components, self.log_weights, starts)
            starts = starts if chosen is None else chosen
        return highest(self, starts)

    @property
    def mean(self) -> Tensor:
        """Mean of real numbers, (*batch, *event); for angles and classes, a NotImplementedError is raised."""
        first, offset, shares = self._moments()
        return first + (shares * offset).sum(self._axis)

    @property
    def variance(self) -> Tensor:
        """Variance of each real number, (*batch, *event), by the law of total variance."""
        _, offset, shares = self._moments()
        deviation = offset - (shares * offset).sum(self._axis, keepdim=True)
        return (shares * (self.components.variance + deviation.square())).sum(self._axis)

    @property
    def _axis(self) -> int:
        """Dimension of a value tensor (*sample, *batch, K, *event) that counts the K components (negative)."""
        return -1 - len(self.event_shape)

    def _moments(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the mean of the first component, the offsets of all component means from this mean, and the weights.

        Raises:
            NotImplementedError: angles and classes have no mean; torch's own densities raise the same error.
        """
        if self.has_enumerate_support or isinstance(self.support, Circular):
            raise NotImplementedError(
                "Angles and classes have no mean. Use mode, median or circular_moments instead."
            )
        means = self.components.mean
        # offsets from one mean: float32 weights sum to 1 only to 1e-7, a large error for means far from 0
        first = means.select(self._axis, 0)
        weights = self.log_weights.exp()[(..., *(None,) * len(self.event_shape))]
        return first, means - first.unsqueeze(self._axis), weights

    def entropy(self) -> Tensor:
        """Return the entropy, nats: exact for classes, by quadrature for one number, from draws for several numbers.

        For several numbers, the entropy of the mixture f = Σ_k w_k p_k is Σ_k w_k (H_k - E_k log f/p_k). Here H_k is
        the entropy of component k, and E_k is a mean over draws from component k. All components get the same number of
        draws, in all about 1000. So only the overlap of components is estimated from random draws.
        """
        count = self.log_weights.shape[-1]
        if count == 1:
            return self.components.entropy().squeeze(-1)
        if self.has_enumerate_support:
            log_prob = self.log_prob(self.enumerate_support())
            return -(log_prob.exp() * log_prob.clamp(min=-1e4)).sum(0)
        if has_range(self):
            return entropy_of_one(self)
        draws_per_component = max(2, 1024 // count)
        size = self.log_weights.numel() * self.event_shape.numel()
        at_once = max(1, LARGEST // max(1, size))
        surprise = torch.cat(
            [
                self._surprise(min(at_once, draws_per_component - start))
                for start in range(0, draws_per_component, at_once)
            ]
        )
        cross_entropies = self.components.entropy() + surprise.mean(0)
        return (self.log_weights.exp() * cross_entropies).sum(-1)

    def _surprise(self, draws: int) -> Tensor:
        """Return log p_k - log f at draws from component k, with p_k the density of the component and f the mixture.

        Args:
            draws: number of draws from each component; the result is (draw, *batch, component).
        """
        samples = self.components.sample(torch.Size((draws,)))
        values = samples.movedim(-1 - len(self.event_shape), 1).flatten(0, 1)
        mixed = self.log_prob(values).unflatten(0, (draws, self.log_weights.shape[-1])).movedim(1, -1)
        return self.components.log_prob(samples) - mixed


def _log_shares(logits: Tensor) -> Tensor:
    """Return log_softmax over the last dimension.

    torch's own function takes four times as long for many rows of few numbers, and is faster for few rows.
    """
    if (
        torch.compiler.is_exporting()  # first, because an exported program must not depend on the size of a batch
        or logits.shape[-1] > SHORT
        or logits.numel() < MANY
        or logits.device.type != "cpu"
    ):
        return torch.log_softmax(logits, -1)
    shifted = logits - logits.detach().amax(-1, keepdim=True)
    return shifted - shifted.exp().sum(-1, keepdim=True).log()


def estimate_of_sum(parts: protocol.Estimate, log_terms: Tensor, log_sum: Tensor) -> protocol.Estimate:
    """Return the estimate of log Σ_k t_k from the estimates of log t_k; k counts along the last dimension.

    The terms must be estimated from independent draws. By the delta method, the squared standard error of the log-sum
    is Σ_k (t_k / Σ_j t_j)² s_k², where s_k is the standard error of log t_k. The numbers of samples add up.

    Args:
        parts: estimates of log t_k, (*items, K). Only their errors, numbers of samples and `unresolved` are used, so
            the estimates may be those of log t_k plus constants.
        log_terms: log t_k, (*items, K).
        log_sum: log Σ_k t_k, (*items,).
    """
    with torch.no_grad():
        whole = log_sum.unsqueeze(-1)
        share = torch.where(whole == -math.inf, 1.0, (log_terms - whole).exp())
        error = parts.standard_error
        # a term with no share adds no error, not even an infinite one; an unknown error stays unknown
        silent = (error == 0) | ((share == 0) & ~error.isnan())
        error = torch.where(silent, 0.0, share * error).square().sum(-1).sqrt()
    return protocol.estimate_with_error(log_sum, error, parts.samples.sum(-1), parts.unresolved.any(-1))


@protocol.estimate.register
def _(density: Mixture, value: Tensor) -> protocol.Estimate:
    """Return the estimate for a mixture whose components use independent draws; for one component, its estimate."""
    several = density.split_values(value)
    if len(several) > 1:
        return concatenate_estimates([protocol.estimate(density, part) for part in several])
    parts = protocol.estimate(density.components, value.unsqueeze(-1 - len(density.event_shape)))
    if density.log_weights.shape[-1] == 1:
        return parts.map_fields(lambda field: field.squeeze(-1))
    error = parts.standard_error.masked_fill(density.log_weights == -math.inf, 0.0)
    log_terms = density.log_weights + parts.log_mean
    return estimate_of_sum(parts._replace(standard_error=error), log_terms, torch.logsumexp(log_terms, -1))


def concatenate_estimates(parts: Sequence[protocol.Estimate]) -> protocol.Estimate:
    """Return one estimate whose fields are the fields of `parts`, concatenated along the first dimension."""
    return protocol.Estimate(*map(torch.cat, zip(*parts, strict=True)))


@protocol.marginal.register
def _(density: Mixture, index: int) -> Distribution:
    return Mixture(density.log_weights, protocol.marginal(density.components, index))


@protocol.even_sample.register
@torch.no_grad()
def _(density: Mixture, count: int) -> Tensor:
    """Return draws of which component k gives w_k `count`, rounded up or down; they are ordered by component.

    The components are chosen at equally spaced places of their cumulative weights, from a random place on (systematic
    sampling). If the components are mixtures too, their components are chosen in the same way.
    """
    components, log_weights = density.components, density.log_weights
    if log_weights.shape[-1] == 1:
        return protocol.even_sample(components, count).squeeze(-1 - len(density.event_shape))
    nested = isinstance(components, Mixture)
    if nested:
        log_weights = (log_weights.unsqueeze(-1) + components.log_weights).flatten(-2)
    cumulative = log_weights.double().exp().cumsum(-1)
    start = torch.rand((*density.batch_shape, 1), dtype=cumulative.dtype, device=cumulative.device)
    steps = torch.arange(count, dtype=cumulative.dtype, device=cumulative.device)
    places = (steps + start) / count * cumulative[..., -1:]
    which = torch.searchsorted(cumulative, places).clamp(max=cumulative.shape[-1] - 1).movedim(-1, 0)
    if not nested:
        return protocol.pick(components, which).sample()
    mixtures, inner = components.log_weights.shape[-2:]
    wide = (which % inner).unsqueeze(-1).expand(*which.shape, mixtures)
    return protocol.pick(protocol.pick(components.components, wide), which // inner).sample()


@protocol.median.register
def _(density: Mixture, samples: int) -> Tensor:
    """Return the median of a mixture.

    No draws are needed for a single component whose median is known, and for components over one real number whose
    distribution function is known. For all others, the result is the median of draws (the default of `median`).

    For several components over images, the mean is returned instead, as `framework.deployment.frozen.Frozen` does: the
    median of few draws is a noisy image, and the median from the distribution function takes a second of processor
    time.
    """
    if density.log_weights.shape[-1] == 1:
        return protocol.median(density.components, samples).squeeze(-1 - len(density.event_shape))
    if len(density.event_shape) == 3:
        return density.mean
    if tuple(density.event_shape) == (1,) and not isinstance(density.support, Circular):
        exact = median_of_real(density)
        if exact is not None:
            return exact
    return protocol.median.dispatch(Distribution)(density, samples)


@protocol.cdf.register
def _(density: Mixture, value: Tensor) -> Tensor | None:
    probabilities = protocol.cdf.dispatch(Distribution)(density, value)
    if probabilities is not None:
        return probabilities
    return _weighted_mean(density, protocol.cdf(density.components, value.unsqueeze(-2)))


@protocol.marginal_cdfs.register
def _(density: Mixture, value: Tensor) -> Tensor | None:
    axis = -1 - len(density.event_shape)
    parts = protocol.marginal_cdfs(density.components, value.unsqueeze(axis))
    return _weighted_mean(
        density, None if parts is None else parts.movedim(axis, -1), len(density.event_shape)
    )


@protocol.arc_probability.register
def _(density: Mixture, start: Tensor, end: Tensor) -> Tensor | None:
    return _weighted_mean(
        density, protocol.arc_probability(density.components, start.unsqueeze(-2), end.unsqueeze(-2))
    )


@protocol.trigonometric_moments.register
def _(density: Mixture, count: int, weights: Tensor | None = None) -> Tensor | None:
    shares = density.log_weights.double().softmax(-1)  # float32 weights sum to 1 only to 1e-7
    moments = protocol.trigonometric_moments(density.components, count, shares)
    return protocol.weighted_moments(moments, weights)


def _weighted_mean(density: Mixture, parts: Tensor | None, numbers: int = 0) -> Tensor | None:
    """Return the mean of probabilities over the components, weighted by the mixture's weights.

    The result is None if `parts` is None.

    Args:
        density: the mixture.
        parts: probabilities from each component, (*sample, *batch, *number, K), or None if they are not known.
        numbers: number of dimensions in *number.
    """
    if parts is None:
        return None
    weights = density.log_weights.double().softmax(-1)  # float32 weights sum to 1 only to 1e-7
    weights = weights[(..., *(None,) * numbers, slice(None))]
    return torch.where(weights > 0, weights * parts, 0.0).sum(-1).clamp(0, 1)


@protocol.highest_region.register
def _(
    density: Mixture, value: Tensor, mass: float, equal: Mapping[torch.dtype, float]
) -> protocol.Region | None:
    if density.log_weights.shape[-1] > 1:
        return None
    region = protocol.highest_region(density.components, value.unsqueeze(-2), mass, equal)
    return None if region is None else protocol.Region(*(number.squeeze(-1) for number in region))


@protocol.normals.register
def _(density: Mixture) -> protocol.Normals | None:
    parts = protocol.normals(density.components)  # (*batch, K, k)
    if parts is None:
        return None
    # normalise again: float32 weights sum to 1 only to 1e-7
    log_weights = density.log_weights.double().log_softmax(-1).unsqueeze(-1) + parts.log_weights
    return protocol.Normals(*(number.flatten(-2) for number in (log_weights, parts.mean, parts.scale)))


@protocol.mahalanobis.register
def _(density: Mixture, value: Tensor) -> Tensor | None:
    if density.log_weights.shape[-1] > 1:
        return None
    distance = protocol.mahalanobis(density.components, value.unsqueeze(-2))
    return None if distance is None else distance.squeeze(-1)


@protocol.quadratic_bound.register
def _(density: Mixture, value: Tensor) -> protocol.QuadraticBound | None:
    parts = protocol.quadratic_bound(density.components, value.unsqueeze(-1 - len(density.event_shape)))
    if parts is None:
        return None
    log_terms = density.log_weights + parts.log_prob
    share = log_terms.softmax(-1).unsqueeze(-1)
    means = (torch.where(share > 0, share * part, 0.0).sum(-2) for part in parts[1:])
    return protocol.QuadraticBound(torch.logsumexp(log_terms, -1), *means)


@protocol.pick.register
def _(density: Mixture, index: Tensor) -> Distribution:
    return PickedMixture(density.log_weights, density.components, index, density.rows)


@protocol.pick.register
def _(density: Reshaped, index: Tensor) -> Distribution:
    """Return the density at `index`; where possible, no samples are drawn from items that are not chosen.

    This is possible if the wrapped density has one batch dimension and is not a mixture.
    """
    inner = density.density
    # a picked mixture draws from all its items for each pick; here these would be the items of the whole batch
    if len(inner.batch_shape) != 1 or isinstance(inner, Mixture):
        return protocol.pick.dispatch(Distribution)(density, index)
    # items in the order of (*batch, K): the item of batch index b and component k is b·K + k
    lead = index.shape[: index.dim() - len(density.batch_shape) + 1]
    count = density.batch_shape[-1]
    first = torch.arange(density.batch_shape[:-1].numel(), device=index.device) * count
    items = first.reshape(density.batch_shape[:-1]) + index
    # `pick` reads the last batch dimension as the components; a batch of one line has no other dimension
    return Reshaped(protocol.pick(inner, items.reshape(-1)), (*lead, *density.batch_shape[:-1]))


@protocol.mode_candidates.register
def _(density: Mixture) -> Tensor:
    candidates = protocol.mode_candidates(density.components).movedim(
        -1 - len(density.event_shape), 0
    )  # (K, peak, *batch, *event)
    return candidates.flatten(0, 1)


@protocol.images.register
def _(density: Mixture, channels: Collection[str]) -> dict[str, Tensor]:
    """Return the images of a single component; for several components over images, the weighted mean of their "color".

    Several components over images have no other channel. Several components over other targets have no image: the image
    of each component shows its own point prediction, which is not the point prediction of the mixture.
    """
    if density.log_weights.shape[-1] == 1:
        axis = len(density.batch_shape)
        return {
            name: image.squeeze(axis) for name, image in protocol.images(density.components, channels).items()
        }
    if len(density.event_shape) != 3 or set(channels) != {"color"}:
        return protocol.images.dispatch(Distribution)(density, channels)
    component_images = protocol.images(density.components, channels)["color"]
    weights = density.log_weights.exp()[..., None, None, None]
    return {"color": (weights * component_images).sum(len(density.batch_shape))}


@protocol.peak_widths.register
def _(density: Mixture) -> Tensor:
    return protocol.peak_widths(density.components).movedim(-1, 0).flatten(0, 1)


@protocol.recentre.register
def _(density: Mixture, index: tuple[Tensor, ...], origin: Tensor) -> Distribution:
    every = torch.arange(density.log_weights.shape[-1], device=origin.device)
    components = protocol.recentre(
        density.components, (*(part.unsqueeze(-1) for part in index), every), origin.unsqueeze(-2)
    )
    return Mixture(density.log_weights.double()[index].expand(components.batch_shape), components)


def circular_grid(density: Distribution, points: int = 360) -> tuple[Tensor, Tensor]:
    """Return angles (points,) in [-π, π) and the log-density there (points, *batch) of a density of one angle.

    The peak of a density that is narrower than the grid (concentration above points²/40) may lie between two angles and
    be missed; use more points for such a density.
    """
    if tuple(density.event_shape) != (1,):
        raise ValueError(
            f"Expected a density of one angle, but got event_shape {tuple(density.event_shape)}. Use marginal()."
        )
    # an empty sample has the density's dtype and device
    like = density.sample(torch.Size((0,)))
    angles = grid(points, dtype=like.dtype, device=like.device)
    value = angles.reshape(points, *(1,) * len(density.batch_shape), 1).expand(
        points, *density.batch_shape, 1
    )
    return angles, density.log_prob(value)
