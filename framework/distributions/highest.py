"""Search for the highest point of a density, uphill from several starting points."""

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular, wrap
from framework.distributions.protocol import QuadraticBound, quadratic_bound

STARTS = 3
"""Number of starting points that are used: those where the density is highest."""
STEPS = 16
"""Largest number of steps."""
LONGEST = 16.0
"""Longest step, as a multiple of the step to the maximum of the bound."""


def highest(density: Distribution, starts: Tensor) -> Tensor:
    """Return a point (*batch, *event) where the density is at least as high as at all starting points.

    If the `quadratic_bound` of the density is known, the point is a local maximum, up to the rounding of log_prob and
    unless more than STEPS steps are needed. It is not the global maximum if no ascent from the starting points leads
    there. If the `quadratic_bound` is not known, the point is the best starting point.

    Args:
        density: the density.
        starts: starting points, (start, *batch, *event).
    """
    height, which = density.log_prob(starts).topk(min(STARTS, len(starts)), 0)
    highest_starts = starts.gather(0, _over_event(density, which))
    top, height = _climb(density, highest_starts, height)
    return top.gather(0, _over_event(density, height.argmax(0, keepdim=True))).squeeze(0)


def crossings(components: Distribution, modes: Tensor) -> Tensor:
    """Return maxima of products of two of K components, (pair, *batch, *event); none if their bounds are not known.

    Two components that are narrow in different numbers may be highest together far from the mode of each.

    Args:
        components: a density with batch_shape (*batch, K).
        modes: modes of the components, (K, *batch, *event).
    """
    # (K, *batch, K, *event): the second component at the first's mode
    both = quadratic_bound(components, modes.unsqueeze(-2))
    if both is None:
        return modes[:0]
    own = both.stiffness.diagonal(dim1=0, dim2=-2).movedim(-1, 0).unsqueeze(-2)
    step = _step_to_top(both.pull, both.stiffness + own, isinstance(components.support, Circular))
    return (modes.unsqueeze(-2) + step).movedim(-2, 0).flatten(0, 1)


def _step_to_top(pull: Tensor, stiffness: Tensor, angles: bool) -> Tensor:
    """Return the step from where a bound touches the density to the bound's maximum; 0 where it is not finite."""
    return (torch.atan2(pull, stiffness) if angles else pull / stiffness).nan_to_num(0.0, 0.0, 0.0)


def _over_event(density: Distribution, index: Tensor) -> Tensor:
    event = density.event_shape
    return index.reshape(*index.shape, *(1,) * len(event)).expand(*index.shape, *event)


@torch.no_grad()
def _climb(density: Distribution, point: Tensor, height: Tensor) -> tuple[Tensor, Tensor]:
    """Return local maxima (start, *batch, *event), one for each starting point, and their log-densities.

    A step leads to the maximum of the bound, where the density is never lower. The step is lengthened by what the last
    step showed (the secant method). For one number this is Newton's method near the maximum, without a second
    derivative.
    """
    bound = quadratic_bound(density, point)
    if bound is None:
        return point, height
    angles = isinstance(density.support, Circular)
    least = 4 * torch.finfo(height.dtype).eps
    reach, rising = torch.ones_like(height), torch.ones_like(height, dtype=torch.bool)
    for _ in range(STEPS):
        step = _step_to_top(bound.pull, bound.stiffness, angles)
        gain = (bound.pull * step).sum(-1)
        rising = rising & (gain > least * height.abs().clamp(min=1))
        if not bool(rising.any()):
            break
        next_point = point + reach.unsqueeze(-1) * step
        next_point = wrap(next_point) if angles else next_point
        next_bound = quadratic_bound(density, next_point)
        assert next_bound is not None
        up = rising & (next_bound.log_prob > height)
        # where not even the bound's maximum is higher, only rounding is left
        rising = up | (rising & (reach > 1))
        left = (next_bound.pull * step).sum(-1) / gain
        longer = torch.where(left < 1, reach / (1 - left), LONGEST).clamp(1, LONGEST)
        reach = torch.where(up, longer, 1.0)
        wide = up.unsqueeze(-1)
        point = torch.where(wide, next_point, point)
        height = torch.where(up, next_bound.log_prob, height)
        bound = QuadraticBound(
            height,
            torch.where(wide, next_bound.pull, bound.pull),
            torch.where(wide, next_bound.stiffness, bound.stiffness),
        )
    return point, height
