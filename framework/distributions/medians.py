"""The median of a mixture over one real number, from its distribution function."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions import protocol

ROUNDS = 100
"""Largest number of steps; Newton's method needs three to six, and bisection alone 60."""
TOLERANCE = 1e-9
"""Largest last step, as a share of the width of the density."""


@torch.no_grad()
def median_of_real(density: Distribution) -> Float[Tensor, "*batch 1"] | None:
    """Return the median of densities of one real number; None if their distribution function is not known.

    The median is the root of F(x) = ½ by Newton's method, whose steps stay in a bracket. The bracket begins at the
    smallest and the largest mode candidate, between which the median of symmetric components lies.
    """
    places = protocol.mode_candidates(density)
    low, high = places.amin(0).double(), places.amax(0).double()
    below, above = protocol.cdf(density, low), protocol.cdf(density, high)
    if below is None or above is None or not bool((below.isfinite() & above.isfinite()).all()):
        return None
    if bool((below > 0.5).any()) or bool((above < 0.5).any()):
        low, high = _widen(density, low, high)
    value = (low + high) / 2
    for _ in range(ROUNDS):
        share = protocol.cdf(density, value)
        assert share is not None
        gap = share.unsqueeze(-1) - 0.5
        low, high = torch.where(gap < 0, value, low), torch.where(gap > 0, value, high)
        height = density.log_prob(value).double().exp().unsqueeze(-1)
        step = value - gap / height
        inside = (step >= low) & (step <= high)  # false where the density is 0 or infinite
        following = torch.where(inside, step, (low + high) / 2)
        moved = (following - value).abs() * height
        value = following
        if not bool((moved > TOLERANCE).any()):
            break
    return value.to(places.dtype)


def _widen(density: Distribution, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Return a bracket that contains the median, by moving the ends outwards in steps of doubling length."""
    reach = protocol.peak_widths(density).amax(0).double().unsqueeze(-1) + (high - low)
    for _ in range(ROUNDS):
        below, above = protocol.cdf(density, low), protocol.cdf(density, high)
        assert below is not None and above is not None
        outside = (below > 0.5).unsqueeze(-1), (above < 0.5).unsqueeze(-1)
        if not bool(outside[0].any() or outside[1].any()):
            break
        low, high = torch.where(outside[0], low - reach, low), torch.where(outside[1], high + reach, high)
        reach = 2 * reach
    return low, high
