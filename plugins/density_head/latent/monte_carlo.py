"""Estimates of log E w(z) over a standard normal z by quasi-random points, to a target standard error."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.closed_forms import normal_quantile
from framework.distributions.density import Mixture, concatenate_estimates
from framework.distributions.protocol import Estimate, estimate, marginal, tempered_density
from framework.distributions.tempering import tempered_classes
from framework.errors import ConfigError

REPLICATES = 8
"""Largest number of independent estimates that a standard error is computed from."""
TO_TOLERANCE, LEAST = 32, 8
"""Number of independent estimates with a tolerance, and smallest number of points of each.

With a tolerance, samples are doubled until the error is small, which favours errors that are small by chance. The error
would be underestimated by a third with 8 estimates, by some percent with 32.
"""
STRETCH = 0.4
"""Heaviness of the tails of these points (`stretched`): in one dimension 3 % lie above 4, of normal ones 0.003 %."""
MOST = 2**18
"""Number of samples after which an item that has not reached its tolerance is given up."""
GENERATOR = 1267
"""Generator of the lattice, chosen by measured variance (benchmarks/densities/latent.md)."""
LARGEST_KEPT = 2**22
"""Largest number of normal points that a density keeps (16 MiB in float32); more are recomputed for every value."""


@dataclass(frozen=True)
class Effort:
    """The number of samples that an estimate takes.

    Args:
        samples: S; with a tolerance, the samples of the first round, rounded up to a power of two and at least 256.
        tolerance: nats. Samples are doubled until an item's estimated error is below, or MOST are drawn. None: S
            samples.

    Raises:
        ConfigError: no sample, or a tolerance that is not above zero.
    """

    samples: int
    tolerance: float | None = None

    def __post_init__(self) -> None:
        if self.samples < 1:
            raise ConfigError(f"samples = {self.samples}; wanted 1 or more.")
        if self.tolerance is not None and not 0 < self.tolerance < math.inf:
            raise ConfigError(
                f"tolerance = {self.tolerance} nats; wanted a number above 0, such as 0.01, or null for a fixed number "
                "of samples."
            )

    @property
    def replicates(self) -> int:
        """Number R of independent parts of the samples: 8, or the largest smaller number that divides a fixed S."""
        if self.tolerance is not None:
            return TO_TOLERANCE
        return next(number for number in range(REPLICATES, 0, -1) if self.samples % number == 0)

    @property
    def first(self) -> int:
        """Number of samples of each replicate in the first round."""
        if self.tolerance is None:
            return self.samples // self.replicates
        return max(LEAST, 1 << (math.ceil(self.samples / TO_TOLERANCE) - 1).bit_length())


class SampledMixture(Mixture):
    """A mixture whose components are a sample of p(φ|x,z): one at each point z, with equal weights.

    Args:
        log_weights: (*batch, S), all equal.
        components: batch_shape (*batch, S), the samples of one replicate adjacent.
        replicates: R, which divides S.
    """

    def __init__(self, log_weights: Tensor, components: Distribution, replicates: int) -> None:
        super().__init__(log_weights, components)
        self.replicates = replicates


@estimate.register
def _(density: SampledMixture, value: Tensor) -> Estimate:
    parts = density.split_values(value)
    if len(parts) > 1:
        return concatenate_estimates([estimate(density, part) for part in parts])
    log_weights = density.components.log_prob(value.unsqueeze(-1 - len(density.event_shape)))
    log_weights = log_weights.unflatten(-1, (density.replicates, -1))
    return estimated(torch.logsumexp(log_weights, -1).movedim(-1, 0), log_weights.shape[-1])


@marginal.register
def _(density: SampledMixture, index: int) -> Distribution:
    return SampledMixture(density.log_weights, marginal(density.components, index), density.replicates)


@tempered_density.register
def _(density: SampledMixture, temperature: Tensor) -> Distribution:
    """Return the mixture of tempered components; of classes the whole is tempered, which keeps the likeliest class."""
    if density.has_enumerate_support:
        return tempered_classes(density, temperature)
    components = tempered_density(density.components, temperature)
    return SampledMixture(density.log_weights, components, density.replicates)


def estimated(
    log_sums: Float[Tensor, "replicate *items"],
    count: int,
    log_shares: Float[Tensor, "replicate *items"] | None = None,
) -> Estimate:
    """Return the estimate from independent replicates, each the log of a sum of `count` weights.

    With shares, whose mean is known to be 1, the estimate is the ratio of both means: it has no error if the weights
    are proportional to the shares. Below, m_r is then the mean weight less the part that the share explains (ratio
    estimator, Cochran 1977, §6).

    With m_r the mean weight of replicate r over that of all, the squared standard error of the mean weight, relative to
    it, is s² = Σ (m_r - 1)² / (R (R - 1)), and s is also that of its logarithm (delta method). The expectation of the
    logarithm is low by s²/2. A jackknife over replicates removes the same term, but is infinite if one replicate has
    all the weight; s² is at most 1, and the correction 1/2.
    """
    replicates = len(log_sums)
    log_count = math.log(replicates * count) if log_shares is None else torch.logsumexp(log_shares, 0)
    log_mean = torch.logsumexp(log_sums, 0) - log_count
    with torch.no_grad():
        ratio = replicates * torch.softmax(log_sums, 0)
        share = 1 if log_shares is None else replicates * torch.softmax(log_shares, 0)
        variance = (ratio - share).square().sum(0) / (
            replicates * (replicates - 1) if replicates > 1 else math.nan
        )
        nothing = log_mean == -math.inf
        standard_error = torch.where(nothing, math.inf, variance.sqrt())
        samples = torch.full(log_mean.shape, replicates * count, dtype=torch.int64, device=log_mean.device)
    correction = torch.where(nothing, 0.0, variance / 2)
    return Estimate(log_mean, log_mean + correction, standard_error, samples, torch.zeros_like(nothing))


def estimated_error(found: Estimate) -> Float[Tensor, "*items"]:
    """Return the root mean square error of log_mean, nats, from standard error and bias together."""
    return torch.hypot(found.standard_error, found.standard_error.square() / 2)


def estimate_log_mean(
    log_weights: Callable[[Tensor, int, int], Tensor],
    items: int,
    effort: Effort,
    *,
    at_once: int,
    device: torch.device,
) -> Estimate:
    """Return log E w of each of `items`, (items,), in rounds that double the samples of items above the tolerance.

    Only a sum for each replicate and the current chunk are held. The result is differentiable if log_weights is; then
    all draws are held, and nothing is chunked.

    Args:
        log_weights: (items (n,) int64, start, count) → (replicate, count, n), nats: of these items, at the points
            `start` to `start + count` of each replicate. -inf is a weight of zero. Or (2, replicate, count, n), of
            weights and of shares as `estimated` reads them.
        items: number of items.
        effort: number of samples, and tolerance.
        at_once: largest number of weights requested together (at least one for each replicate).
        device: device of the weights.
    """
    if torch.is_grad_enabled():
        at_once = max(at_once, items * effort.replicates * MOST)
    rows = torch.arange(items, device=device)
    log_sums = _log_sums(log_weights, rows, 0, effort.first, effort.replicates, at_once)
    done = effort.first
    finished: list[tuple[Tensor, Estimate]] = []
    while True:
        found = (
            estimated(log_sums, done) if log_sums.dim() == 2 else estimated(log_sums[0], done, log_sums[1])
        )
        if effort.tolerance is None:
            return found
        # a NaN weight stays NaN, whatever is added
        wanting = ~(estimated_error(found) <= effort.tolerance)
        more = wanting & ~found.log_mean.isnan()
        if effort.replicates * done * 2 > MOST:
            more = torch.zeros_like(more)
        found = found._replace(unresolved=wanting)
        finished.append((rows[~more], found.map_fields(lambda field, chosen=~more: field[chosen])))
        if not more.any():
            break
        rows = rows[more]
        further = _log_sums(log_weights, rows, done, done, effort.replicates, at_once)
        log_sums = torch.logaddexp(log_sums[..., more], further)
        done *= 2
    order = torch.cat([rows for rows, _ in finished]).argsort()
    return concatenate_estimates([part for _, part in finished]).map_fields(lambda field: field[order])


def _log_sums(
    log_weights: Callable[[Tensor, int, int], Tensor],
    rows: Tensor,
    start: int,
    count: int,
    replicates: int,
    at_once: int,
) -> Float[Tensor, "*pair replicate rows"]:
    """Return the log of the sum of `count` weights of each replicate, computed chunk by chunk."""
    step = max(1, min(count, at_once // replicates))
    parts = []
    for some in rows.split(max(1, at_once // (replicates * step))):
        total = None
        for begin in range(start, start + count, step):
            number = min(step, start + count - begin)
            part = torch.logsumexp(log_weights(some, begin, number), -2)
            total = part if total is None else torch.logaddexp(total, part)
        parts.append(total)
    return torch.cat(parts, -1)


def rows_of(
    value: Tensor, batch_shape: torch.Size, event_shape: torch.Size
) -> tuple[Tensor, Tensor, torch.Size]:
    """Return values (*sample, *batch, *event) as rows, with the item of each row and the shape of the result.

    Returns:
        Values (rows, *event); the item of the flattened batch that each row belongs to, (rows,) int64; and the shape
        (*sample, *batch) of the result.
    """
    lead = value.shape[: value.dim() - len(event_shape)]
    shape = torch.Size(torch.broadcast_shapes(lead, batch_shape))
    items = torch.arange(batch_shape.numel(), device=value.device).reshape(batch_shape).expand(shape)
    return value.expand(shape + event_shape).reshape(-1, *event_shape), items.reshape(-1), shape


class NormalPoints:
    """Standard normal points z: a sequence for each item and replicate that can be extended without limit.

    All are one extensible lattice (`lattice`), each shifted by a random vector modulo 1 (Cranley & Patterson 1976), so
    that a replicate's mean is unbiased and replicates are independent, and mapped by the normal quantile. They are
    drawn from torch's global generator in float64, so that float32 and float64 get the same points.

    Args:
        items: number of items of a flattened batch.
        replicates: R.
        dimensions: dimensions of z.
        dtype, device: of the points.
        kept: number of first points of each replicate that are kept from first use, for many values at the same points;
            none are kept if they exceed LARGEST_KEPT.
    """

    def __init__(
        self,
        items: int,
        replicates: int,
        dimensions: int,
        *,
        dtype: torch.dtype,
        device: torch.device,
        kept: int = 0,
    ) -> None:
        self.shift = torch.rand(replicates, 1, items, dimensions, dtype=torch.float64, device=device)
        self.dtype = dtype
        self.kept = kept if self.shift.numel() * kept <= LARGEST_KEPT else 0

    def __call__(
        self, items: Int[Tensor, "rows"], start: int, count: int
    ) -> Float[Tensor, "replicate count rows dimension"]:
        """Return points `start` to `start + count` of the sequences of some items."""
        if start + count <= self.kept:
            return self._first[:, start : start + count, items]
        return self._points(self.shift[:, :, items], start, count)

    @cached_property
    def _first(self) -> Tensor:
        return self._points(self.shift, 0, self.kept)

    def _points(self, shift: Tensor, start: int, count: int) -> Tensor:
        places = lattice(start, count, shift.shape[-1], shift.device)
        return normal_quantile(torch.remainder(places[:, None] + shift, 1.0)).to(self.dtype)


def stretched(
    points: Float[Tensor, "*shape dimension"],
) -> tuple[Float[Tensor, "*shape dimension"], Float[Tensor, "*shape"]]:
    """Return points of heavier tails, z = y exp(h y²/2) of standard normal y (Tukey's h), and the log of their shares.

    A share is the standard normal density at z over the density of the points. Weights times shares have the mean that
    weights have under normal points, but no weight is large only in a region with hardly any point (defensive sampling,
    Hesterberg 1995).
    """
    h = STRETCH / points.shape[-1] ** 0.5
    square = points.square()
    z = points * (h / 2 * square).exp()
    return z, ((1 + h) / 2 * square + (h * square).log1p() - z.square() / 2).sum(-1)


def lattice(
    start: int, count: int, dimensions: int, device: torch.device | None = None
) -> Float[Tensor, "count dimension"]:
    """Return points `start` to `start + count` of an extensible Korobov sequence in [0, 1), float64 and exact.

    Point i is r(i) (1, a, a², …) mod 1 with r the radical inverse: the binary digits of i mirrored at the binary point.
    The first 2^m points, for any m, are a whole lattice (Hickernell, Hong, L'Ecuyer & Lemieux 2000, §2).
    """
    number = torch.arange(start, start + count, device=device)
    inverse = torch.zeros(count, dtype=torch.float64, device=device)
    for bit in range((start + count - 1).bit_length()):
        inverse += ((number >> bit) & 1) * 2.0 ** -(bit + 1)
    # below 2^20, so that products with numbers of up to 32 bits are exact
    vector = [pow(GENERATOR, power, 2**20) for power in range(dimensions)]
    return torch.remainder(inverse[:, None] * torch.tensor(vector, dtype=torch.float64, device=device), 1.0)
