"""Search for the highest point of a density, uphill from several starting points."""

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular, wrap
from framework.distributions.protocol import QuadraticBound, quadratic_bound

STARTS = 3
"""Number of starting points of the search: those of the given places where the density is highest."""
STEPS = 16
"""Largest number of steps."""
LONGEST = 16.0
"""Longest step, as a multiple of the step to the maximum of the bound."""


def highest(density: Distribution, places: Tensor) -> Tensor:
    """Return a point (*batch, *event) where the density is at least as high as at all `places` (place, *batch, *event).

    Where the density knows its `quadratic_bound`, the point is a local maximum, up to the rounding of log_prob and within STEPS
    steps from the highest places. It is not the global maximum if no ascent from these places leads there. Where the
    `quadratic_bound` is not known, the point is the best of `places`.
    """
    height, which = density.log_prob(places).topk(min(STARTS, len(places)), 0)
    start = places.gather(0, _over_event(density, which))
    top, height = _climb(density, start, height)
    return top.gather(0, _over_event(density, height.argmax(0, keepdim=True))).squeeze(0)


def crossings(components: Distribution, modes: Tensor) -> Tensor:
    """Return maxima of the products of two of K components, (place, *batch, *event), where their `quadratic_bound` is known.

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
def _climb(density: Distribution, place: Tensor, height: Tensor) -> tuple[Tensor, Tensor]:
    """Return local maxima (start, *batch, *event), one for each starting point, and their log-densities.

    A step leads to the maximum of the bound, where the density is never lower. The step is lengthened by what the last
    step showed (the secant method). For one number this is Newton's method near the maximum, without a second
    derivative.
    """
    bound = quadratic_bound(density, place)
    if bound is None:
        return place, height
    angles = isinstance(density.support, Circular)
    least = 4 * torch.finfo(height.dtype).eps
    reach, rising = torch.ones_like(height), torch.ones_like(height, dtype=torch.bool)
    for _ in range(STEPS):
        step = _step_to_top(bound.pull, bound.stiffness, angles)
        gain = (bound.pull * step).sum(-1)
        rising = rising & (gain > least * height.abs().clamp(min=1))
        if not bool(rising.any()):
            break
        next_place = place + reach.unsqueeze(-1) * step
        next_place = wrap(next_place) if angles else next_place
        next_bound = quadratic_bound(density, next_place)
        assert next_bound is not None
        up = rising & (next_bound.log_prob > height)
        # where not even the bound's maximum is higher, only rounding is left
        rising = up | (rising & (reach > 1))
        left = (next_bound.pull * step).sum(-1) / gain
        longer = torch.where(left < 1, reach / (1 - left), LONGEST).clamp(1, LONGEST)
        reach = torch.where(up, longer, 1.0)
        wide = up.unsqueeze(-1)
        place = torch.where(wide, next_place, place)
        height = torch.where(up, next_bound.log_prob, height)
        bound = QuadraticBound(
            height,
            torch.where(wide, next_bound.pull, bound.pull),
            torch.where(wide, next_bound.stiffness, bound.stiffness),
        )
    return place, height
