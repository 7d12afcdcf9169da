"""Trigonometric moments of a density of one angle, computed on a grid, and quantities that follow from them."""

import math

import torch
from jaxtyping import Bool, Complex, Float
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular
from framework.distributions.density import circular_grid
from framework.distributions.protocol import trigonometric_moments

POINTS = (720, 2880)
"""Number of angles on the coarse grid, and on the fine grid for densities that the coarse grid does not resolve."""
MASS_GAP = 1e-4
"""Largest accepted difference between 1 and a density's integral over a grid.

If the difference is larger, the grid does not resolve the density.
"""
COARSE_ENOUGH = {torch.float64: 1e-8}
"""Largest |m_n| of a density that counts as resolved by the coarse grid, for the highest orders n that this grid gives.

The keys are number types. m_n are the moments of `CircularMoments`.
"""
ROUNDED = 4e-6
"""Value of COARSE_ENOUGH for number types with fewer digits than float64.

In float32, rounding alone gives the moments of the highest orders a size of 2e-6, which no finer grid reduces.
"""
LAST_MOMENTS = 1e-4
"""Largest |m_n| of a density that counts as resolved by the fine grid, for the highest orders n that this grid gives.

Moments of still higher orders are taken as 0. A von Mises density with concentration 3,500 (σ = 1°) does not need the
fine grid, and one with 100,000 (σ = 0.18°) is still resolved on the fine grid.
"""


class CircularMoments:
    """Moments m_n = E exp(i n X), n = 0 ... N/2, of densities of one angle X, from grids of N angles.

    Source: Mardia & Jupp 2000, §3.4.1.

    Args:
        moments: the moments m_n in the order of n; m_0 is 1.
        resolved: true where the grid resolved the density. Where it is false, the moments are meaningless, and draws
            must be used instead. A density that is NaN counts as resolved.
    """

    def __init__(self, moments: Complex[Tensor, "harmonic *batch"], resolved: Bool[Tensor, "*batch"]) -> None:
        self.moments = moments
        self.resolved = resolved
        order = torch.arange(1, len(moments), dtype=torch.float64, device=moments.device)
        self.order = order.reshape(-1, *(1,) * resolved.dim())

    @property
    def direction(self) -> Float[Tensor, "*batch"]:
        """Mean direction, radians in [-π, π]; 0 where |m_1| is below 1e-6, since no direction is defined there."""
        first = self.moments[1]
        return torch.where(first.abs() < 1e-6, 0.0, first.angle())

    def arc_probability(self, start: Tensor, end: Tensor) -> Tensor:
        """Return the probability of the arc from `start` counter-clockwise to `end`, (*sample, *batch).

        The Fourier series of the density is integrated term by term, so the probability is as exact as the moments.

        Args:
            start: first end of the arc, (*sample, *batch), radians.
            end: second end of the arc, (*sample, *batch), radians.
        """
        length = torch.remainder(end - start, 2 * math.pi)
        return self._series(length, start).clamp(0, 1)

    def _series(self, length: Tensor, start: Tensor) -> Tensor:
        if start.dim() > self.resolved.dim():
            pairs = zip(length, start.expand_as(length), strict=True)
            return torch.stack([self._series(*pair) for pair in pairs])
        ends = torch.polar(torch.ones_like(self.order), -self.order * (start + length))
        starts = torch.polar(torch.ones_like(self.order), -self.order * start)
        # ∫ Re(m_n e^{-inφ}) dφ = Re(i m_n e^{-inφ} / n) = -Im(m_n e^{-inφ}) / n
        parts = -(self.moments[1:] * (ends - starts)).imag / self.order
        return length / (2 * math.pi) + parts.sum(0) / math.pi

    def distance(self, value: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Return the mean angular distance E d(X - y) between X and y = `value`, radians.

        The distance d is computed by its Fourier series, d(θ) = π/2 - 4/π Σ cos(nθ)/n² over odd n.
        """
        turned = self.moments[1:] * torch.polar(torch.ones_like(self.order), -self.order * value)
        return math.pi / 2 - 4 / math.pi * (turned.real / self.order.square())[::2].sum(0)

    @property
    def spread(self) -> Float[Tensor, "*batch"]:
        """Mean angular distance E d(X - X'), radians, of X and an independent copy X', by the series of `distance`."""
        squares = self.moments[1:].abs().square()
        return math.pi / 2 - 4 / math.pi * (squares / self.order.square())[::2].sum(0)

    def density(self, finer: int, *, slope: bool = False) -> Float[Tensor, "points *batch"]:
        """Return the density on equally spaced angles from -π, interpolated by its Fourier series.

        Args:
            finer: number of these angles, as a multiple of the number N of angles on the grid of the moments.
            slope: if true, return the derivative of the density, per radian, instead of the density.
        """
        count = 2 * (len(self.moments) - 1) * finer
        sign = 1 - 2 * (torch.arange(len(self.moments), device=self.moments.device) % 2)
        turned = self.moments.conj() * sign.reshape(-1, *(1,) * self.resolved.dim())
        turned[-1] /= 2  # the highest moment is the mean of two coefficients and stands for both
        if slope:
            turned[0] = 0
            turned[1:] *= 1j * self.order
        if turned.numel() == 0:
            return turned.real.new_zeros(count, *self.resolved.shape)
        return torch.fft.irfft(turned, n=count, dim=0) * (count / (2 * math.pi))


@torch.no_grad()
def circular_moments(density: Distribution) -> CircularMoments:
    """Return the trigonometric moments of a density of one angle.

    If `protocol.trigonometric_moments` knows the moments, they are returned. Otherwise they are computed by the
    trapezium rule on a grid, which is spectrally exact for smooth densities. Items of the batch that the coarse grid
    does not resolve are evaluated on the fine grid. The other items keep their moments from the coarse grid, so that
    the moments of an item do not depend on the rest of the batch.

    Raises:
        ValueError: the density is not over one angle.
    """
    moments, resolved = _on_grid(density, POINTS[0])
    if bool(resolved.all()):
        return CircularMoments(moments, resolved)
    fine, fine_resolved = _on_grid(density, POINTS[1])
    wide = torch.zeros_like(fine)
    wide[: len(moments)] = moments
    return CircularMoments(torch.where(resolved, wide, fine), resolved | fine_resolved)


def _on_grid(density: Distribution, points: int) -> tuple[Tensor, Tensor]:
    dtype = density.sample(torch.Size((0,))).dtype
    largest = COARSE_ENOUGH.get(dtype, ROUNDED) if points == POINTS[0] else LAST_MOMENTS
    known = trigonometric_moments(density, points // 2 + 1)
    if known is not None:
        last = _largest_of_last(known)
        return known, (last < largest) | last.isnan()
    angles, log_density = circular_grid(density, points)
    mass = log_density.double().exp() * (2 * math.pi / points)
    support = density.support
    if isinstance(support, Circular) and support.ranges is not None:
        low, high = support.ranges[0]
        inside = (angles >= low) & (angles <= high)
        mass = mass * inside.reshape(-1, *(1,) * (mass.dim() - 1))
    total = mass.sum(0)
    if total.numel() == 0:  # the fast Fourier transform refuses an empty batch
        nothing = torch.zeros(points // 2 + 1, *total.shape, dtype=torch.complex128, device=total.device)
        return nothing, total > 0
    moments = torch.fft.rfft(mass / total, dim=0).conj().resolve_conj()
    moments[1::2] *= -1  # the grid begins at -π
    grid_resolves = ((total - 1).abs() < MASS_GAP) & (_largest_of_last(moments) < largest)
    return moments, grid_resolves | total.isnan()


def _largest_of_last(moments: Complex[Tensor, "harmonic *batch"]) -> Float[Tensor, "*batch"]:
    """Return the largest absolute value of the moments whose orders are in the highest twentieth."""
    return moments[-max(2, len(moments) // 20) :].abs().amax(0)
