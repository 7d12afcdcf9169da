"""The density of one real number whose quantile function is linear between given quantiles."""

from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import constraints

from framework.distributions import protocol
from framework.distributions.description import PlainDensity


class PiecewiseQuantiles(PlainDensity):
    """The density of one real number with a piecewise linear quantile function and Pareto tails.

    Between the quantiles q_k and q_(k+1) of the probabilities τ_k and τ_(k+1) the density is uniform with the
    probability τ_(k+1) - τ_k (Gasthaus et al. 2019, with knots at the quantiles). Beyond the outermost quantiles it is
    a generalised Pareto density (Ehrlich, Callot & Aubet 2021) with the shape ξ, which is continuous with the density
    of the adjacent interval: p = (1 - τ_K)/b · (1 + ξ d)^(-1 - 1/ξ) for d = (y - q_K)/b and b = (1 - τ_K) (q_K -
    q_(K-1))/(τ_K - τ_(K-1)), and likewise below q_1. For ξ = 0 the tails are exponential.

    Args:
        location: the middle quantile, (*batch, 1).
        steps: distances of neighbouring quantiles, above 0, (*batch, level - 1).
        probabilities: τ, an odd number, ascending in (0, 1), (level,), float64.
        tail: ξ in [0, ½).
    """

    has_rsample = True

    def __init__(
        self,
        location: Float[Tensor, "*batch 1"],
        steps: Float[Tensor, "*batch piece"],
        probabilities: Float[Tensor, "level"],
        tail: float,
    ) -> None:
        self.location = location
        self.steps = steps
        self.probabilities = probabilities.to(steps)
        self.tail = tail
        super().__init__(steps.shape[:-1], torch.Size((1,)), validate_args=False)

    @cached_property
    def offsets(self) -> Float[Tensor, "*batch level"]:
        """Distances of the quantiles from the middle one, so that a location far from 0 costs no digits."""
        middle = self.steps.shape[-1] // 2
        below = -self.steps[..., :middle].flip(-1).cumsum(-1).flip(-1)
        return torch.cat(
            [below, torch.zeros_like(self.steps[..., :1]), self.steps[..., middle:].cumsum(-1)], -1
        )

    @property
    def quantiles(self) -> Float[Tensor, "*batch level"]:
        """Quantiles at the given probabilities, ascending."""
        return self.location + self.offsets

    @property
    def support(self) -> constraints.Constraint:
        """Support of the density."""
        return constraints.real_vector

    @cached_property
    def _log_heights(self) -> Float[Tensor, "*batch piece"]:
        """Log-density between neighbouring quantiles, nats."""
        return self.probabilities.diff().log() - self.steps.log()

    @cached_property
    def _tail_scales(self) -> tuple[Tensor, Tensor]:
        """Scales b of the Pareto densities of the lower and of the upper tail, (*batch,) each."""
        heights = self._log_heights
        lower = self.probabilities[0] * torch.exp(-heights[..., 0])
        return lower, (1 - self.probabilities[-1]) * torch.exp(-heights[..., -1])

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density, nats, (*sample, *batch)."""
        number = (value - self.location).squeeze(-1)
        shape = number.shape
        piece = (self.offsets <= number.unsqueeze(-1)).sum(-1)
        heights = self._log_heights.expand(*shape, -1)
        inner = heights.gather(-1, (piece - 1).clamp(0, heights.shape[-1] - 1).unsqueeze(-1)).squeeze(-1)
        low, high = self._tail_scales
        below = (self.offsets[..., 0] - number).clamp(min=0) / low
        above = (number - self.offsets[..., -1]).clamp(min=0) / high
        last = self.offsets.shape[-1]
        tails = torch.where(
            piece == 0, heights[..., 0] - self._fall(below), heights[..., -1] - self._fall(above)
        )
        return torch.where((piece == 0) | (piece == last), tails, inner)

    def _fall(self, distance: Tensor) -> Tensor:
        """Return a tail's log-density at its beginning minus its log-density at `distance` from there, nats.

        `distance` is in units of the tail's scale b.
        """
        if self.tail == 0:
            return distance
        return (1 + 1 / self.tail) * torch.log1p(self.tail * distance)

    def cdf(self, value: Tensor) -> Tensor:
        """Return P(X ≤ y), float64 (*sample, *batch), for values (*sample, *batch, 1)."""
        quantiles, probabilities = self.offsets.double(), self.probabilities.double()
        number = (value.double() - self.location.double()).squeeze(-1)
        last = quantiles.shape[-1]
        piece = (quantiles <= number.unsqueeze(-1)).sum(-1)
        start = (piece - 1).clamp(0, last - 2)
        wide = quantiles.expand(*number.shape, last)
        left = wide.gather(-1, start.unsqueeze(-1)).squeeze(-1)
        right = wide.gather(-1, start.unsqueeze(-1) + 1).squeeze(-1)
        share = ((number - left) / (right - left)).clamp(0, 1)
        inner = probabilities[start] + share * (probabilities[start + 1] - probabilities[start])
        low, high = (scale.double() for scale in self._tail_scales)
        below = probabilities[0] * self._survival((quantiles[..., 0] - number).clamp(min=0) / low)
        above = (1 - probabilities[-1]) * self._survival((number - quantiles[..., -1]).clamp(min=0) / high)
        return torch.where(piece == 0, below, torch.where(piece == last, 1 - above, inner))

    def _survival(self, distance: Tensor) -> Tensor:
        """Return the share of a tail's probability that lies farther than `distance` from its beginning.

        `distance` is in units of the tail's scale b.
        """
        if self.tail == 0:
            return torch.exp(-distance)
        return torch.exp(-torch.log1p(self.tail * distance) / self.tail)

    def icdf(self, probability: Tensor) -> Tensor:
        """Return the quantile for probabilities (*sample, *batch)."""
        quantiles = self.quantiles
        last = quantiles.shape[-1]
        piece = torch.searchsorted(self.probabilities, probability.contiguous(), right=True)
        start = (piece - 1).clamp(0, last - 2)
        wide = quantiles.expand(*probability.shape, last)
        left = wide.gather(-1, start.unsqueeze(-1)).squeeze(-1)
        right = wide.gather(-1, start.unsqueeze(-1) + 1).squeeze(-1)
        first, then = self.probabilities[start], self.probabilities[start + 1]
        inner = left + ((probability - first) / (then - first)).clamp(0, 1) * (right - left)
        low, high = self._tail_scales
        tiny = torch.finfo(probability.dtype).tiny
        below = self._distance((probability / self.probabilities[0]).clamp(tiny, 1))
        above = self._distance(((1 - probability) / (1 - self.probabilities[-1])).clamp(tiny, 1))
        lower, upper = quantiles[..., 0] - low * below, quantiles[..., -1] + high * above
        return torch.where(piece == 0, lower, torch.where(piece == last, upper, inner))

    def _distance(self, share: Tensor) -> Tensor:
        """Return the distance from a tail's beginning, in units of its scale, beyond which `share` of its mass lies."""
        return -share.log() if self.tail == 0 else torch.expm1(-self.tail * share.log()) / self.tail

    def rsample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        """Return samples, (*sample, *batch, 1), differentiable in the quantiles."""
        shape = torch.Size(sample_shape) + self.batch_shape
        uniform = torch.rand(shape, dtype=self.steps.dtype, device=self.steps.device)
        return self.icdf(uniform).unsqueeze(-1)

    @property
    def median(self) -> Tensor:
        """Median, (*batch, 1)."""
        half = torch.full(self.batch_shape, 0.5, dtype=self.steps.dtype, device=self.steps.device)
        return self.icdf(half).unsqueeze(-1)

    @property
    def mode(self) -> Tensor:
        """Middle of the interval of highest density, (*batch, 1)."""
        return self.middles.gather(-1, self._log_heights.argmax(-1, keepdim=True))

    @property
    def middles(self) -> Float[Tensor, "*batch piece"]:
        """Middles of the intervals between neighbouring quantiles."""
        return self.location + (self.offsets[..., 1:] + self.offsets[..., :-1]) / 2

    @property
    def mean(self) -> Tensor:
        """Mean, (*batch, 1)."""
        return self.location + self._moments()[0].unsqueeze(-1)

    @property
    def variance(self) -> Tensor:
        """Variance, (*batch, 1)."""
        first, second = self._moments()
        return (second - first.square()).unsqueeze(-1)

    @property
    def stddev(self) -> Tensor:
        """Standard deviation, (*batch, 1)."""
        return self.variance.sqrt()

    def _moments(self) -> tuple[Tensor, Tensor]:
        """Return the first and second moment about the location, (*batch,) each."""
        q = self.offsets
        left, right, mass = q[..., :-1], q[..., 1:], self.probabilities.diff()
        first = (mass * (left + right) / 2).sum(-1)
        second = (mass * (left.square() + left * right + right.square()) / 3).sum(-1)
        tail = self.tail
        ends = (self.probabilities[0], 1 - self.probabilities[-1])
        for sign, end, scale, share in zip(
            (-1, 1), (q[..., 0], q[..., -1]), self._tail_scales, ends, strict=True
        ):
            mean, square = scale / (1 - tail), 2 * scale.square() / ((1 - tail) * (1 - 2 * tail))
            first = first + share * (end + sign * mean)
            second = second + share * (end.square() + 2 * sign * end * mean + square)
        return first, second

    def entropy(self) -> Tensor:
        """Return the entropy, nats, (*batch)."""
        inner = -(self.probabilities.diff() * self._log_heights).sum(-1)
        heights = self._log_heights
        # over a tail, the mean of `_fall` is 1 + ξ
        lower = self.probabilities[0] * (1 + self.tail - heights[..., 0])
        return inner + lower + (1 - self.probabilities[-1]) * (1 + self.tail - heights[..., -1])


protocol.estimate.register(PiecewiseQuantiles, protocol.exact_estimate)


@protocol.median.register
def _(density: PiecewiseQuantiles, samples: int) -> Tensor:
    return density.median


@protocol.cdf.register
def _(density: PiecewiseQuantiles, value: Tensor) -> Tensor:
    return density.cdf(value)


@protocol.pick.register
def _(density: PiecewiseQuantiles, index: Tensor) -> PiecewiseQuantiles:
    location, steps = (protocol.take(part, index) for part in (density.location, density.steps))
    return PiecewiseQuantiles(location, steps, density.probabilities, density.tail)


@protocol.recentre.register
def _(density: PiecewiseQuantiles, index: tuple[Tensor, ...], origin: Tensor) -> PiecewiseQuantiles:
    location = density.location.double()[index] - origin
    steps = density.steps.double()[index]
    return PiecewiseQuantiles(
        location, steps.expand(*location.shape[:-1], -1), density.probabilities, density.tail
    )


@protocol.mode_candidates.register
def _(density: PiecewiseQuantiles) -> Tensor:
    return density.middles.movedim(-1, 0).unsqueeze(-1)


@protocol.ranked_score.register
def _(density: PiecewiseQuantiles, value: Tensor) -> Tensor:
    """Return the continuous ranked probability score, the integral of (F(x) - [x ≥ y])² over x.

    It is a sum of integrals over the pieces of the density.
    """
    quantiles, probabilities = density.offsets.double(), density.probabilities.double()
    number = value.double() - density.location.double()
    left, right = quantiles[..., :-1], quantiles[..., 1:]
    first, then = probabilities[:-1], probabilities[1:]
    cut = torch.minimum(torch.maximum(number, left), right)
    at_cut = first + (cut - left) / (right - left) * (then - first)
    total = _squares(first, at_cut, cut - left) + _squares(1 - at_cut, 1 - then, right - cut)
    result = total.sum(-1)
    number = number.squeeze(-1)
    low, high = (scale.double() for scale in density._tail_scales)
    ends = (
        (quantiles[..., 0] - number, probabilities[0], low),
        (number - quantiles[..., -1], 1 - probabilities[-1], high),
    )
    for distance, share, scale in ends:
        outside = distance.clamp(min=0) / scale
        result = result + scale * _tail_score(density, outside, share)
    return result


def _squares(first: Tensor, then: Tensor, length: Tensor) -> Tensor:
    """Return the integral of the square of a linear function, which runs from `first` to `then`, over `length`."""
    return length * (first.square() + first * then + then.square()) / 3


def _tail_score(density: PiecewiseQuantiles, outside: Tensor, share: Tensor) -> Tensor:
    """Return the part of the score that comes from a tail with the probability `share`, in units of its scale.

    Args:
        density: the density.
        outside: distance of the target from the beginning of the tail, in units of its scale; 0 if the target is not in
            the tail.
        share: probability of the tail.
    """
    shape = density.tail

    def beyond(power: int) -> Tensor:
        """Return the integral, from `outside` to infinity, of the survival function raised to a power."""
        if shape == 0:
            return torch.exp(-power * outside) / power
        return torch.exp((1 - power / shape) * torch.log1p(shape * outside)) / (power - shape)

    def whole(power: int) -> float:
        return 1 / (power - shape)

    # up to the target F̄ = 1 - share · survival counts, beyond it share · survival
    before = outside - 2 * share * (whole(1) - beyond(1)) + share**2 * (whole(2) - beyond(2))
    return before + share**2 * beyond(2)
