"""The median of a mixture over one real number, from its distribution function."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions import protocol

ROUNDS = 100
"""Largest number of steps; Newton's method needs three to six, and bisection alone 60."""
TOLERANCE = 1e-6
"""Largest difference of the distribution function from ½ before the last step.

After this step, the difference is about the square of this number.
"""


@torch.no_grad()
def median_of_real(density: Distribution) -> Float[Tensor, "*batch 1"] | None:
    """Return the median of densities of one real number; None if their distribution function is not known.

    The median is the root of F(x) = ½ by Newton's method, which begins at the mean of the mode candidates. If a step
    leaves the bracket of the root, the bracket is halved instead.
    """
    places = protocol.mode_candidates(density).double()
    low, high, value = places.amin(0), places.amax(0), places.mean(0)
    bracketed = False
    for _ in range(ROUNDS):
        share = protocol.cdf(density, value)
        if share is None or not bool(share.isfinite().all()):
            return None
        gap = share.unsqueeze(-1) - 0.5
        height = density.log_prob(value).double().exp().unsqueeze(-1)
        step = value - gap / height
        inside = (step >= low) & (step <= high)  # false where the density is 0 or infinite
        if not bracketed and not bool(inside.all()):
            low, high = _widen(density, low, high)
            bracketed = True
            inside = (step >= low) & (step <= high)
        low, high = torch.where(gap < 0, value, low), torch.where(gap > 0, value, high)
        wrong = gap.abs() > TOLERANCE
        value = torch.where(inside, step, torch.where(wrong, (low + high) / 2, value))
        if not bool(wrong.any()):
            break
    return value.to(protocol.mode_candidates(density).dtype)


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
