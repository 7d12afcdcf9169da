"""Trigonometric moments of von Mises densities, from a recurrence of Bessel functions."""

import math

import torch
from jaxtyping import Complex, Float
from torch import Tensor

NEGLIGIBLE = 1e-17
"""Moments of an absolute value below this one are taken as 0."""
AHEAD = 256
"""Number of orders by which the start of the recurrence lies above the highest moment.

The error of the value at the start dies out over these orders.
"""
FEW = 2**18
"""Number of moments, summed over all densities, up to which a few calls of torch compute all orders together.

More moments are computed order by order, which needs less memory.
"""
AT_ONCE = 2**21
"""Largest number of moments of single densities that are kept in memory at once (16 MiB)."""


@torch.no_grad()
def trigonometric_moments(
    mean: Float[Tensor, "*batch"], concentration: Float[Tensor, "*batch"], count: int, weights: Tensor | None
) -> Complex[Tensor, "count ..."]:
    """Return the moments E exp(i n X) = I_n(κ) / I_0(κ) exp(i n μ), n = 0 … count - 1, of von Mises densities.

    The quotients r_n = I_n / I_{n-1} follow from r_n = κ / (2n + κ r_{n+1}), which is stable for falling n (Gautschi
    1967). The recurrence starts `AHEAD` orders above the highest moment, or where moments are negligible. Source of the
    moments: Mardia & Jupp 2000, §3.5.4.

    Args:
        mean: μ, radians, float64.
        concentration: κ, float64.
        count: Number of moments, at least 2.
        weights: Weights, (*batch), with which the moments are summed over the last dimension; None for no sum.

    Returns:
        Moments, (count, *batch), or with weights their sums, (count, *batch[:-1]).
    """
    if weights is None:
        mean, concentration = mean.unsqueeze(-1), concentration.unsqueeze(-1)
        return trigonometric_moments(mean, concentration, count, torch.ones_like(mean))
    shape = mean.shape[:-1]
    rows = [
        part.reshape(-1, part.shape[-1]) for part in torch.broadcast_tensors(mean, concentration, weights)
    ]
    moments = mean.new_zeros(count, len(rows[0]), dtype=torch.complex128)
    if moments.numel() == 0 or mean.shape[-1] == 0:
        return moments.reshape(count, *shape)
    start = _highest_order(float(concentration.nan_to_num(nan=0.0).amax()), count + AHEAD)
    highest = min(start, count - 1)
    step = max(1, AT_ONCE // (mean.shape[-1] * (highest + 1)))
    first = 0
    for angle, width, weight in zip(*(row.split(step) for row in rows), strict=True):
        last = first + len(angle)
        _sum_moments(angle, width, weight, start, moments[: highest + 1, first:last])
        first = last
    return moments.reshape(count, *shape)


def _sum_moments(mean: Tensor, concentration: Tensor, weights: Tensor, start: int, into: Tensor) -> None:
    """Write the weighted sums of the moments over the last dimension into `into`, (order, row).

    The quotient after the order `start` is taken as κ / (n + 1/2 + √(κ² + (n + 1)² - 1/4)), n = `start`, which agrees
    with the quotient for large κ up to terms of the order 1/κ³ and lies between its bounds (Amos 1974, eq. 9 and 11).
    """
    highest = len(into) - 1
    quotients = torch.empty(highest, *mean.shape, dtype=torch.float64, device=mean.device)
    far = torch.full_like(mean, math.sqrt((start + 1) ** 2 - 0.25))
    following = concentration / (start + 0.5 + torch.hypot(concentration, far))
    twice = 2 * torch.arange(start + 1, dtype=torch.float64, device=mean.device)
    for order in range(start, 0, -1):
        following = concentration / torch.addcmul(twice[order], concentration, following)
        if order <= highest:
            quotients[order - 1] = following
    into[0] = weights.sum(-1)
    if quotients.numel() <= FEW:  # in few calls of torch, each of which takes some microseconds
        orders = (twice[1 : highest + 1] / 2).reshape(-1, *(1,) * mean.dim())
        torch.sum(weights * torch.polar(quotients.cumprod(0), orders * mean), -1, out=into[1:])
    else:  # with multiplications only, in little memory
        power = torch.complex(weights, torch.zeros_like(weights))
        turn = torch.polar(torch.ones_like(mean), mean)
        for order in range(1, highest + 1):
            power *= turn * quotients[order - 1]
            torch.sum(power, -1, out=into[order])
    into[0] += into[1] * 0  # a density that is NaN has no moments at all


def _highest_order(concentration: float, count: int) -> int:
    """Return the largest order below `count` whose moment is not negligible, at least 1.

    The quotients are at most κ / (n - 1/2 + √(κ² + (n - 1/2)²)) (Amos 1974, eq. 9).
    """
    order = torch.arange(1, count, dtype=torch.float64) - 0.5
    bound = concentration / (order + torch.hypot(torch.tensor(concentration, dtype=torch.float64), order))
    return max(1, int((bound.log().cumsum(0) > math.log(NEGLIGIBLE)).sum()))
