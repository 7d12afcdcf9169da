"""Estimates of log E w(z) over a standard normal z by quasi-random points, to a target standard error.

w(z) is the weight of the point z. The points are divided into replicates: parts of equal size that are independent of
each other, so that the spread of their means gives the standard error.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.closed_forms import normal_quantile
from framework.distributions.density import Mixture, concatenate_estimates
from framework.distributions.exported import Exported, exported
from framework.distributions.protocol import Estimate, estimate, marginal, tempered_density
from framework.distributions.shapes import broadcast_shapes
from framework.distributions.tempering import tempered_classes
from framework.errors import ConfigError

REPLICATES = 8
"""Largest number of replicates from which a standard error is computed if there is no tolerance."""
TO_TOLERANCE, LEAST = 32, 8
"""Number of replicates if there is a tolerance, and smallest number of points of each replicate.

With a tolerance, samples are doubled until the estimated error is small, which favours errors that are small by chance.
With 8 replicates the error would be underestimated by a third, with 32 only by some percent.
"""
STRETCH = 0.4
"""Parameter h of `stretch` in one dimension: for a larger h, more points are far from 0.

With this value 3 % of the points lie above 4, but only 0.003 % of normal points.
"""
MOST = 2**18
"""Largest number of samples of an item; an item whose error is then still above the tolerance counts as unresolved."""
GENERATOR = 1267
"""Multiplier a of `lattice`, chosen for small measured variance (benchmarks/densities/latent.md)."""
LARGEST_KEPT = 2**22
"""Largest number of normal points that a density keeps in memory (16 MiB in float32); more are recomputed."""


@dataclass(frozen=True)
class Effort:
    """The number of samples that an estimate takes.

    Args:
        samples: S; with a tolerance, the samples of the first round, rounded up to a power of two and at least 256.
        tolerance: nats. Samples are doubled until an item's estimated error is below the tolerance, or MOST samples are
            drawn. None: exactly S samples.

    Raises:
        ConfigError: `samples` is below 1, or the tolerance is not above 0.
    """

    samples: int
    tolerance: float | None = None

    def __post_init__(self) -> None:
        if self.samples < 1:
            raise ConfigError(f"density_head.samples is {self.samples}, expected 1 or more.")
        if self.tolerance is not None and not 0 < self.tolerance < math.inf:
            raise ConfigError(
                f"density_head.tolerance is {self.tolerance} nats, expected a number above 0, such as 0.01, or null "
                "for a fixed number of samples."
            )

    @property
    def replicates(self) -> int:
        """Number R of replicates, the independent parts of the samples.

        With a tolerance, R is TO_TOLERANCE. Without a tolerance, R is the largest number up to REPLICATES that divides
        S.
        """
        if self.tolerance is not None:
            return TO_TOLERANCE
        return next(number for number in range(REPLICATES, 0, -1) if self.samples % number == 0)

    @property
    def first(self) -> int:
        """Number of samples of each replicate in the first round; later rounds double the samples."""
        if self.tolerance is None:
            return self.samples // self.replicates
        return max(LEAST, 1 << (math.ceil(self.samples / TO_TOLERANCE) - 1).bit_length())


class SampledMixture(Mixture):
    """A mixture with equal weights whose components are p(φ|x,z) at S random points z.

    Args:
        log_weights: (*batch, S), all equal.
        components: batch_shape (*batch, S); the components of one replicate are adjacent.
        replicates: R, the number of independent parts of the points; it divides S.
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
    return estimate_from_sums(torch.logsumexp(log_weights, -1).movedim(-1, 0), log_weights.shape[-1])


@marginal.register
def _(density: SampledMixture, index: int) -> Distribution:
    return SampledMixture(density.log_weights, marginal(density.components, index), density.replicates)


@exported.register
def _(density: SampledMixture) -> Exported:
    weights = {"log_weights": density.log_weights}
    return Exported("mixture", weights, {"components": exported(density.components)})


@tempered_density.register
def _(density: SampledMixture, temperature: Tensor) -> Distribution:
    """Return the tempered mixture.

    For angles and real numbers its components are tempered. For classes the whole mixture is tempered, which keeps its
    mode.
    """
    if density.has_enumerate_support:
        return tempered_classes(density, temperature)
    components = tempered_density(density.components, temperature)
    return SampledMixture(density.log_weights, components, density.replicates)


def estimate_from_sums(
    log_sums: Float[Tensor, "replicate *items"],
    count: int,
    log_shares: Float[Tensor, "replicate *items"] | None = None,
) -> Estimate:
    """Return the estimate of the log of a mean weight, nats, with its standard error, from independent replicates.

    Let m_r be the mean weight of replicate r divided by the mean weight of all R replicates. The squared relative
    standard error of the mean weight is s² = Σ (m_r - 1)² / (R (R - 1)), and s is also the standard error of its
    logarithm (delta method). The expectation of the logarithm is too small by s²/2; the field `debiased` of the result
    has this correction. A jackknife over replicates removes the same term, but is infinite if one replicate has all the
    weight. In contrast, s² is at most 1, and the correction at most 1/2.

    The share of a point is its standard normal density divided by the density from which it was drawn (`stretch`), and
    has the expectation 1. If shares are given, the estimate is the ratio of the mean weight to the mean share, which
    has no error if the weights are proportional to the shares. The 1 in s² is then replaced by the mean share of
    replicate r divided by the mean share of all replicates (ratio estimator, Cochran 1977, §6).

    Args:
        log_sums: log of the sum of the weights of each replicate.
        count: number of weights of each replicate.
        log_shares: log of the sum of the shares of each replicate; None if the points are standard normal.
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


def estimated_error(result: Estimate) -> Float[Tensor, "*items"]:
    """Return the estimated root mean square error of `result.log_mean`, nats.

    It is √(s² + (s²/2)²) for the standard error s and the bias s²/2.
    """
    return torch.hypot(result.standard_error, result.standard_error.square() / 2)


def estimate_log_mean(
    log_weights: Callable[[Tensor, int, int], Tensor],
    items: int,
    effort: Effort,
    *,
    at_once: int,
    device: torch.device,
) -> Estimate:
    """Return an estimate of log E w, the log of the mean weight over z, for each item, (items,), nats.

    After each round, the samples of the items with an error above the tolerance are doubled. Only one sum for each
    replicate and the current chunk are in memory. The result is differentiable if log_weights is; then all weights are
    in memory at once.

    Args:
        log_weights: function of (items (n,) int64, start, count) that returns (replicate, count, n): the log of the
            weights of these items at the points `start` to `start + count` of each replicate, nats, -inf for a weight
            of 0. It may return (2, replicate, count, n) instead: first the logs of the weights, each multiplied by the
            share of its point, then the logs of these shares. The share of a point is its standard normal density
            divided by the density from which it was drawn (`stretch`).
        items: number of items.
        effort: number of samples, and tolerance.
        at_once: largest number of weights requested together (at least one for each replicate).
        device: device of the weights.
    """
    if torch.is_grad_enabled():
        at_once = max(at_once, items * effort.replicates * MOST)
    rows = torch.arange(items, device=device)
    log_sums = _log_sums(log_weights, rows, 0, effort.first, effort.replicates, at_once)
    drawn_count = effort.first
    finished: list[tuple[Tensor, Estimate]] = []
    while True:
        result = (
            estimate_from_sums(log_sums, drawn_count)
            if log_sums.dim() == 2
            else estimate_from_sums(log_sums[0], drawn_count, log_sums[1])
        )
        if effort.tolerance is None:
            return result
        # the estimate of a NaN weight stays NaN, so that more samples cannot help
        wanting = ~(estimated_error(result) <= effort.tolerance)
        more = wanting & ~result.log_mean.isnan()
        if effort.replicates * drawn_count * 2 > MOST:
            more = torch.zeros_like(more)
        result = result._replace(unresolved=wanting)
        finished.append((rows[~more], result.map_fields(lambda field, chosen=~more: field[chosen])))
        if not more.any():
            break
        rows = rows[more]
        further = _log_sums(log_weights, rows, drawn_count, drawn_count, effort.replicates, at_once)
        log_sums = torch.logaddexp(log_sums[..., more], further)
        drawn_count *= 2
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
    """Return the log of the sum of `count` weights of each replicate, from the point `start` on, nats.

    The sum is computed in chunks of at most `at_once` weights. If `log_weights` also returns the logs of shares, the
    logs of their sums are returned too, in the first dimension of size 2.
    """
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
    """Return values (*sample, *batch, *event) as rows, with the batch element of each row and the shape of log_prob.

    Returns:
        Values (rows, *event); the item of the flattened batch that each row belongs to, (rows,) int64; and the shape
        (*sample, *batch) of the result.
    """
    lead = value.shape[: value.dim() - len(event_shape)]
    shape = broadcast_shapes(lead, batch_shape)
    items = torch.arange(batch_shape.numel(), device=value.device).reshape(batch_shape).expand(shape)
    return value.expand(shape + event_shape).reshape(-1, *event_shape), items.reshape(-1), shape


class NormalPoints:
    """Standard normal points z: one sequence, of any length, for each item and replicate.

    Every sequence is the same lattice (`lattice`), shifted by its own random vector modulo 1 (Cranley & Patterson 1976)
    and mapped by the normal quantile. So the mean of a replicate is unbiased, and replicates are independent. The
    shifts come from torch's global generator in float64, so that float32 and float64 have the same points.

    Args:
        items: number of items of a flattened batch.
        replicates: number R of replicates, the independent parts of an item's points.
        dimensions: dimensions of z.
        dtype, device: dtype and device of the points.
        kept_count: number of points at the start of each replicate that stay in memory after their first use, because
            many values are evaluated at the same points. If the points of all items and replicates hold more than
            LARGEST_KEPT numbers, none of them is kept.
    """

    def __init__(
        self,
        items: int,
        replicates: int,
        dimensions: int,
        *,
        dtype: torch.dtype,
        device: torch.device,
        kept_count: int = 0,
    ) -> None:
        self.shift = torch.rand(replicates, 1, items, dimensions, dtype=torch.float64, device=device)
        self.dtype = dtype
        # a trace depends on no size of a batch
        few = not torch.compiler.is_exporting() and self.shift.numel() * kept_count <= LARGEST_KEPT
        self.kept_count = kept_count if few else 0

    def __call__(
        self, items: Int[Tensor, "rows"], start: int, count: int
    ) -> Float[Tensor, "replicate count rows dimension"]:
        """Return the points `start` to `start + count` of the sequences of the given items."""
        if start + count <= self.kept_count:
            return self._first[:, start : start + count, items]
        return self._points(self.shift[:, :, items], start, count)

    @cached_property
    def _first(self) -> Tensor:
        return self._points(self.shift, 0, self.kept_count)

    def _points(self, shift: Tensor, start: int, count: int) -> Tensor:
        places = lattice(start, count, shift.shape[-1], shift.device)
        return normal_quantile(torch.remainder(places[:, None] + shift, 1.0)).to(self.dtype)


def stretch(
    points: Float[Tensor, "*shape dimension"],
) -> tuple[Float[Tensor, "*shape dimension"], Float[Tensor, "*shape"]]:
    """Return points with heavier tails, z = y exp(h y²/2) for the normal `points` y, and the log of their shares.

    The transform is Tukey's, with h = STRETCH / √d for d dimensions. The share of a point is the standard normal
    density at z divided by the density of the transformed points at z. Weights times shares at these points have the
    same mean as weights at normal points, but regions far from 0 hold more points, so that large weights there are not
    missed (defensive sampling, Hesterberg 1995).
    """
    h = STRETCH / points.shape[-1] ** 0.5
    square = points.square()
    z = points * (h / 2 * square).exp()
    return z, ((1 + h) / 2 * square + (h * square).log1p() - z.square() / 2).sum(-1)


def lattice(
    start: int, count: int, dimensions: int, device: torch.device | None = None
) -> Float[Tensor, "count dimension"]:
    """Return points `start` to `start + count` of an extensible Korobov sequence in [0, 1), float64, without rounding.

    Point i is r(i) (1, a, a², …) mod 1, with a = GENERATOR and the radical inverse r, which mirrors the binary digits
    of i at the binary point. The first 2^m points, for any m, are a complete lattice (Hickernell, Hong, L'Ecuyer &
    Lemieux 2000, §2).
    """
    # by NumPy, so that the points are constants in the trace of an exported model
    number = np.arange(start, start + count)
    inverse = np.zeros(count)
    for bit in range((start + count - 1).bit_length()):
        inverse += ((number >> bit) & 1) * 2.0 ** -(bit + 1)
    # below 2^20, so that products with numbers of up to 32 bits are exact
    vector = np.array([pow(GENERATOR, power, 2**20) for power in range(dimensions)], dtype=np.float64)
    return torch.from_numpy(np.remainder(inverse[:, None] * vector, 1.0)).to(device)
