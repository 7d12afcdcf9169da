"""Densities with a prediction set for the target: a set of labels, arcs, intervals, or a region."""

import math
from functools import cached_property
from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.distributions.circular import Circular
from framework.distributions.exported import Exported, exported
from framework.distributions.intervals import central_interval
from framework.distributions.protocol import ValueSet, mahalanobis, marginal
from framework.distributions.unchanged import Unchanged
from framework.errors import ConfigError, UserError
from plugins.uncertainty.conformal.highest_density import Ends, Line

Score = Literal["density", "mass", "quantiles"]
FEW = 8
"""Largest number of values per item for which `contains` compares the score of each value with the threshold.

For more values it is faster to compute the log-density at the threshold once, and to compare log-densities with it.
"""
DRAWS = 1000
"""Number of samples of each density over several numbers, from which scores and volumes of its sets are estimated."""
MARGIN_STEPS = 1000
"""Number of steps in one unit of log(1 + m) to which this number is rounded before u is taken from it.

m is the margin between the two likeliest classes, nats.
"""
GOLDEN_RATIO = (math.sqrt(5) - 1) / 2
"""Number whose multiples modulo 1 are spread evenly (Knuth 1998, The Art of Computer Programming 3, §6.4)."""
WIDENED = (1.0, 2.0, 4.0, 8.0)
"""Factors by which a density over several reals is widened, so that samples cover its whole prediction set.

The set of an overconfident density is larger than the region in which the density's own samples lie.
"""


class PredictionSet(Unchanged, ValueSet):
    """A density, unchanged to the last bit, and the set of values whose score is at most a threshold.

    A score is larger for a less expected value:

    - "density": -log p(y), nats. The set holds the values with a density above one level, the same for every item (for
      classes Sadinle, Lei & Wasserman 2019).
    - "mass": -log of the probability of all values with a smaller density than y, nats. The set is the smallest region
      of a given probability, which is the same for every item (for classes Romano, Sesia & Candès 2020, for numbers a
      highest-density region). For classes, (1 - u(x)) p(y) is added to this probability; u(x) in (0, 1) looks random,
      but is a function of the density. Without this term, the least likely class would always have an infinite score,
      whatever its probability.
    - "quantiles": max(a - y, y - b) for the ends a and b of the central interval of the stated probability, for one
      real number in its unit. The set is the interval from a - threshold to b + threshold (conformalised quantile
      regression; Romano, Patterson & Candès 2019, eq. 6 and 8).

    All scores are functions of the density and the value alone, as split conformal prediction requires: on
    exchangeable data the set has its stated coverage for any density (Vovk, Gammerman & Shafer 2005, §4.1).
    For a target of several numbers, probabilities are shares of random samples, which are drawn once.

    Args:
        density: any density.
        threshold: the largest score in the set, a scalar; infinite for all values.
        score: "density", "mass" or "quantiles".
        stated_probability: probability with which the set is stated to hold the target; None if it is not known.

    Raises:
        ConfigError: the score is "quantiles", and the density is not over one real number, or no probability is stated.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    def __init__(
        self,
        density: Distribution,
        threshold: Float[Tensor, ""],
        score: Score,
        stated_probability: float | None = None,
    ) -> None:
        self.stated_probability = stated_probability
        self.threshold = threshold
        self.score: Score = score
        if score == "quantiles" and stated_probability is None:
            raise ConfigError(
                "score='quantiles' needs the probability of the central interval, but stated_probability is None. Pass "
                "a number between 0 and 1."
            )
        if score == "quantiles" and (
            density.has_enumerate_support
            or tuple(density.event_shape) != (1,)
            or isinstance(density.support, Circular)
        ):
            raise ConfigError(
                "uncertainty.conformal.score=quantiles moves the two ends of an interval of one real number, but the "
                f"predicted density is a {type(density).__name__} of event_shape {tuple(density.event_shape)}. Choose "
                "score=density or score=mass."
            )
        super().__init__(density)

    @torch.no_grad()
    def scores(self, value: Tensor) -> Float[Tensor, "*shape"]:
        """Return the score of each value (*sample, *batch, *event), float64; larger is less expected.

        The score is in nats, and for "quantiles" in the unit of the target.
        """
        if self.score == "quantiles":
            low, high = self._central
            number = value.double().squeeze(-1)
            return torch.maximum(low - number, number - high)
        log_prob = self.density.log_prob(value).double()
        if self.score == "density":
            return -log_prob
        if self._classes:
            return _label_scores(log_prob, self._log_labels)
        if log_prob.numel() == 0:
            return log_prob
        if self._one_number:
            flat = log_prob.reshape(-1, self._line.items)
            return torch.stack([self._line.score_of(level) for level in flat]).reshape(log_prob.shape)
        return _share_scores(log_prob, self._log_draws)

    @torch.no_grad()
    def contains(self, value: Tensor) -> Bool[Tensor, "*shape"]:
        """Return whether each value (*sample, *batch, *event) is in the set of its batch element.

        No value is in the set of a density that is NaN.
        """
        if self._holds_everything:
            return ~self.density.log_prob(value).isnan()
        several = value.numel() > FEW * self.batch_shape.numel()
        if self._one_number and self.score == "mass" and several:
            return self.density.log_prob(value).double() >= self._level.reshape(self.batch_shape)
        return self.scores(value) <= self.threshold

    @torch.no_grad()
    def size(self) -> Float[Tensor, "*batch"]:
        """Return the size of each set, float64.

        The size is the number of labels for classes, the total length of the arcs (radians) or intervals for one
        number, and the volume for several numbers. The volume is exact for a normal density, whose set is an ellipsoid,
        and otherwise an estimate with the standard error `size_error`. The size is infinite if the set is unbounded,
        and NaN if the density is NaN.
        """
        if self._classes:
            return self.labels().sum(-1).double()
        if self._one_number:
            return self._ends.length.reshape(self.batch_shape)
        if self._holds_everything:
            return self._log_draws[0].new_full(self.batch_shape, self._support_volume)
        return self._volume[0]

    @torch.no_grad()
    def size_error(self) -> Float[Tensor, "*batch"]:
        """Return the standard error of `size`, float64; it is 0 unless the size is estimated from samples."""
        size = self.size()
        if self._classes or self._one_number or self._holds_everything:
            return torch.zeros_like(size)
        return self._volume[1]

    @cached_property
    @torch.no_grad()
    def _volume(self) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        """Volume of each set of several numbers, and its standard error, which is 0 for normal densities."""
        mode = self.density.mode
        if mahalanobis(self.density, mode) is not None:
            volume = self._ellipsoid(self.density.log_prob(mode).double())
            return volume, torch.zeros_like(volume)
        # Importance sampling with several proposals of equal shares and the balance heuristic (Veach & Guibas 1995,
        # eq. 9). For angles the proposals are the density and the uniform density; for reals the density, widened
        # around its mode by each of the factors.
        draws, factors = self._draws, WIDENED
        if isinstance(self.support, Circular):
            ranges = self.support.ranges or ((-math.pi, math.pi),) * self.event_shape[0]
            low, high = torch.tensor(ranges, dtype=torch.float64, device=draws.device).T
            uniform = low + torch.rand(draws.shape, dtype=torch.float64, device=draws.device) * (high - low)
            places = [draws, uniform.to(draws.dtype)]
            log_whole = math.log(self._support_volume)

            def log_proposal(value: Tensor) -> Tensor:
                own = self.density.log_prob(value).double()
                return torch.logaddexp(own, torch.full_like(own, -log_whole)) - math.log(2)
        else:
            places = [mode + factor * (draws - mode) for factor in factors]

            def log_proposal(value: Tensor) -> Tensor:
                log_densities = [
                    self.density.log_prob(mode + (value - mode) / factor).double() - volume
                    for factor, volume in ((c, self.event_shape[0] * math.log(c)) for c in factors)
                ]
                return torch.stack(log_densities).logsumexp(0) - math.log(len(factors))

        parts = [torch.where(self.contains(y), (-log_proposal(y)).exp(), 0.0) for y in places]
        volume = torch.stack([part.mean(0) for part in parts]).mean(0)
        variance = torch.stack([part.var(0) / len(part) for part in parts]).sum(0) / len(parts) ** 2
        broken = self.density.log_prob(mode).isnan()
        return volume.masked_fill(broken, math.nan), variance.sqrt()

    def _ellipsoid(self, top: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Return the volume of the set of a normal density, an ellipsoid; `top` is log p at the mode, nats."""
        count = self.event_shape[0]
        level = -self.threshold.to(top) if self.score == "density" else self._level_of_share
        radius = (2 * (top - level)).clamp(min=0).sqrt()
        # |Σ|^½ = exp(-top) (2π)^(-n/2); the ball's π^(n/2) / Γ(n/2 + 1)
        log_volume = count / 2 * math.log(math.pi) - math.lgamma(count / 2 + 1) + count * radius.log()
        return (log_volume - top - count / 2 * math.log(2 * math.pi)).exp()

    @property
    def _level_of_share(self) -> Float[Tensor, "*batch"]:
        """Smallest log-density, nats, at which the mass score (`_share_scores`) is at most the threshold."""
        log_draws, threshold = self._log_draws, float(self.threshold)
        if threshold < 0:  # no score is negative
            return torch.full_like(log_draws[0], math.inf)
        beyond = threshold - math.log(len(log_draws) + 1)
        if beyond > 0:
            return log_draws[0] - beyond
        rank = (len(log_draws) + 1) * math.exp(-threshold) - 1
        if rank > len(log_draws):
            return torch.full_like(log_draws[0], math.inf)
        above = min(int(rank), len(log_draws) - 1)
        if above < 1:
            return log_draws[0]
        return log_draws[above - 1] + min(rank - above, 1.0) * (log_draws[above] - log_draws[above - 1])

    def empty(self) -> Bool[Tensor, "*batch"]:
        """Return for each set whether it is empty."""
        if self._classes:
            return ~self.labels().any(-1)
        if self._one_number:
            return self.size() == 0
        return ~(self.contains(self._draws).any(0) | self.contains(self.density.mode))

    def labels(self) -> Bool[Tensor, "*batch label"]:
        """Return for each class whether it is in the set.

        Raises:
            UserError: the density is not over classes.
        """
        if not self._classes:
            raise UserError(
                "labels() exists only for sets of classes, but this set holds numbers. Use intervals() or "
                "contains(value)."
            )
        return self.contains(self.density.enumerate_support()).movedim(0, -1)

    def intervals(self) -> list[list[tuple[float, float]]]:
        """Return the set of every item of the flattened batch as intervals (low, high), in ascending order.

        The ends of an interval of a real may be infinite. An interval of an angle is in radians, from low in [-π, π)
        counter-clockwise to high, which may lie beyond π but is at most low + 2π; the whole circle is (-π, π). The ends
        are as exact as the density's dtype. An interval is found only if it contains a mode candidate of the density
        or, for angles, if it is broad.

        Raises:
            UserError: the density is not over one number.
        """
        if not self._one_number:
            raise UserError(
                "intervals() exists only for sets of one angle or one real number. For classes use labels(); for "
                "several numbers use contains(value), or the prediction set of the marginal() of each number."
            )
        return self._ends.intervals

    def parts(self) -> list[list[int]] | list[list[tuple[float, float]]] | None:
        """Return what each set contains: labels for classes, intervals for one number, None for several numbers."""
        if self._classes:
            labels = self.labels().reshape(-1, len(self._log_labels))
            return [row.nonzero().flatten().tolist() for row in labels]
        return self.intervals() if self._one_number else None

    @property
    def _classes(self) -> bool:
        return self.density.has_enumerate_support

    @property
    def _one_number(self) -> bool:
        return tuple(self.event_shape) == (1,)

    @property
    def _holds_everything(self) -> bool:
        return float(self.threshold) == math.inf

    @property
    def _support_volume(self) -> float:
        """Volume of the support of the density: the product of the ranges of its angles, or infinity for reals."""
        support = self.support
        if not isinstance(support, Circular):
            return math.inf
        ranges = support.ranges or ((-math.pi, math.pi),) * self.event_shape[0]
        return math.prod(high - low for low, high in ranges)

    @cached_property
    @torch.no_grad()
    def _log_labels(self) -> Float[Tensor, "label *batch"]:
        return self.density.log_prob(self.density.enumerate_support()).double()

    @cached_property
    @torch.no_grad()
    def _draws(self) -> Tensor:
        return self.density.sample(torch.Size((DRAWS,)))

    @cached_property
    @torch.no_grad()
    def _log_draws(self) -> Float[Tensor, "draw *batch"]:
        return self.density.log_prob(self._draws).double().sort(0).values

    @cached_property
    @torch.no_grad()
    def _line(self) -> Line:
        return Line(self.density)

    @cached_property
    @torch.no_grad()
    def _level(self) -> Float[Tensor, "item"]:
        """Smallest log-density in the set of one number, nats, for each item."""
        threshold = self.threshold.double().to(self._line.heights.device)
        if self.score == "mass" and not self._holds_everything:
            return self._line.level_of(threshold)
        return (-threshold).expand(self._line.items)

    @cached_property
    @torch.no_grad()
    def _central(self) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        """Ends of the central interval of the stated probability."""
        assert self.stated_probability is not None
        interval = central_interval(self.density, self.stated_probability)
        return interval.low.squeeze(-1), interval.high.squeeze(-1)

    @cached_property
    @torch.no_grad()
    def _ends(self) -> Ends:
        if self.score == "quantiles":
            threshold = self.threshold.double()
            low, high = (
                (end + sign * threshold).flatten() for end, sign in zip(self._central, (-1, 1), strict=True)
            )
            pairs = zip(low.tolist(), high.tolist(), strict=True)
            intervals = [[(start, end)] if start <= end else [] for start, end in pairs]
            return Ends((high - low).clamp(min=0), intervals)
        return self._line.ends(self._level)


def _label_scores(log_prob: Tensor, every: Float[Tensor, "label *batch"]) -> Tensor:
    """Return the mass score of labels y, nats: -log(Σ_j p_j + (1 - u) p(y)), with the sum over all j with p_j < p(y).

    u is the u(x) of `PredictionSet`. Romano, Sesia & Candès 2020 (eq. 5) sum over the more probable labels
    instead. Their sum is 1 minus this one, and rounds to 1 where small differences matter.

    Args:
        log_prob: log p(y) of the labels.
        every: log-probabilities of all labels.
    """
    top = every.topk(min(2, len(every)), dim=0).values
    margin = top[0] - top[-1]
    # Equal inputs must have equal u, also if rounding changes the last bits of the margin, whatever its size.
    step = (MARGIN_STEPS * margin.where(margin.isfinite(), 0.0).log1p()).round()
    share = torch.frac(step * GOLDEN_RATIO).clamp(1e-6, 1 - 1e-6)
    less = torch.where(
        _broadcast_labels(every, log_prob) < log_prob, _broadcast_labels(every, log_prob), -math.inf
    ).logsumexp(0)
    return -torch.logaddexp(less, log_prob + torch.log1p(-share))


def _broadcast_labels(every: Tensor, values: Tensor) -> Tensor:
    """Return `every` (label, *batch) with dimensions of size 1 inserted, so that it broadcasts with `values`.

    `values` are (*sample, *batch); one dimension of size 1 is inserted for each dimension of `sample`.
    """
    return every.reshape(len(every), *(1,) * (values.dim() - every.dim() + 1), *every.shape[1:])


def _share_scores(log_prob: Tensor, log_draws: Float[Tensor, "draw *batch"]) -> Tensor:
    """Return the mass score, nats: -log of the share of samples with a smaller log-density than `log_prob`.

    `log_draws` are the log-densities of the samples, ascending. The share is interpolated linearly between two samples,
    and below the first sample the score is linear in log p, so that equal scores are rare.
    """
    edges = log_draws.movedim(0, -1).contiguous()
    lead = log_prob.shape[: log_prob.dim() - edges.dim() + 1]
    flat = log_prob.reshape(lead.numel(), *edges.shape[:-1]).movedim(0, -1).contiguous()
    above = torch.searchsorted(edges, flat)
    low, high = (
        edges.gather(-1, (above - 1).clamp(min=0)),
        edges.gather(-1, above.clamp(max=len(log_draws) - 1)),
    )
    part = torch.where(high > low, (flat - low) / (high - low), 0.0).clamp(0, 1)
    rank = above + part.where((above > 0) & (above < len(log_draws)), 0.0)
    beyond = (edges[..., :1] - flat).clamp(min=0)
    score = math.log(len(log_draws) + 1) - (rank + 1).log() + beyond
    return score.movedim(-1, 0).reshape(log_prob.shape)


@marginal.register
def _(density: PredictionSet, index: int) -> Distribution:
    """Return the marginal density of one number, without a prediction set if there are several numbers.

    The coverage of the set holds for all numbers together, and says nothing about a single one of several numbers.
    """
    return density if tuple(density.event_shape) == (1,) and index == 0 else marginal(density.density, index)


@exported.register
def _(density: PredictionSet) -> Exported:
    if density.score != "density":
        raise ConfigError(
            f"A prediction set with score={density.score} cannot be exported, because its region depends on the whole "
            "density of each input. Calibrate the model with score=density, or use framework.load for this model."
        )
    # JSON has no infinite numbers
    # the trace of an exported model depends on no value; its layout is read outside of the trace
    threshold = math.inf if torch.compiler.is_exporting() else density.threshold.item()
    settings = {
        "threshold": threshold if math.isfinite(threshold) else str(threshold),
        "stated_probability": density.stated_probability,
    }
    code = "plugins.uncertainty.conformal.numpy_prediction_set"
    return Exported("prediction_set", {}, {"inner": exported(density.density)}, settings, code)
