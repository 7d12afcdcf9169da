"""Where a density is highest, uphill from a few places."""

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular, wrap
from framework.distributions.protocol import Slope, slope

STARTS = 3
"""So many of the places given, the highest, are climbed from."""
STEPS = 16
LONGEST = 16.0
"""The longest step, in steps to the top of the bound."""


def highest(density: Distribution, places: Tensor) -> Tensor:
    """A point (*batch, *event) where the density is as high as at any of `places` (place, *batch, *event), or higher.

    Where the density knows its `slope` it is a local maximum, to the rounding of log_prob and as far as STEPS lead,
    reached from the highest places: not the highest point of all where no way up from these leads there. Where it does
    not, it is the best place.
    """
    height, which = density.log_prob(places).topk(min(STARTS, len(places)), 0)
    start = places.gather(0, _over_event(density, which))
    top, height = _climbed(density, start, height)
    return top.gather(0, _over_event(density, height.argmax(0, keepdim=True))).squeeze(0)


def crossings(components: Distribution, modes: Tensor) -> Tensor:
    """Tops of the products of two of K components with batch_shape (*batch, K), (place, *batch, *event), where their
    `slope` is known: two that are narrow in different numbers may be highest together far from the mode of each.

    Args:
        modes: of the components, (K, *batch, *event).
    """
    both = slope(components, modes.unsqueeze(-2))  # (K, *batch, K, *event): the second's at the first's mode
    if both is None:
        return modes[:0]
    own = both.stiffness.diagonal(dim1=0, dim2=-2).movedim(-1, 0).unsqueeze(-2)
    step = _to_top(both.pull, both.stiffness + own, isinstance(components.support, Circular))
    return (modes.unsqueeze(-2) + step).movedim(-2, 0).flatten(0, 1)


def _to_top(pull: Tensor, stiffness: Tensor, angles: bool) -> Tensor:
    """From where a bound touches to its top; 0 where that is no number."""
    return (torch.atan2(pull, stiffness) if angles else pull / stiffness).nan_to_num(0.0, 0.0, 0.0)


def _over_event(density: Distribution, index: Tensor) -> Tensor:
    event = density.event_shape
    return index.reshape(*index.shape, *(1,) * len(event)).expand(*index.shape, *event)


@torch.no_grad()
def _climbed(density: Distribution, place: Tensor, height: Tensor) -> tuple[Tensor, Tensor]:
    """Places (start, *batch, *event) from which no step leads up any more, and their log-densities.

    A step leads to the top of the bound, which is never lower, and on by what the last step has told (the secant): of
    one number that is Newton's method near the top, without a second derivative.
    """
    here = slope(density, place)
    if here is None:
        return place, height
    angles = isinstance(density.support, Circular)
    least = 4 * torch.finfo(height.dtype).eps
    reach, rising = torch.ones_like(height), torch.ones_like(height, dtype=torch.bool)
    for _ in range(STEPS):
        step = _to_top(here.pull, here.stiffness, angles)
        gain = (here.pull * step).sum(-1)
        rising = rising & (gain > least * height.abs().clamp(min=1))
        if not bool(rising.any()):
            break
        there = place + reach.unsqueeze(-1) * step
        there = wrap(there) if angles else there
        found = slope(density, there)
        assert found is not None
        up = rising & (found.log_prob > height)
        # where not even the bound's top is higher, rounding decides
        rising = up | (rising & (reach > 1))
        left = (found.pull * step).sum(-1) / gain
        longer = torch.where(left < 1, reach / (1 - left), LONGEST).clamp(1, LONGEST)
        reach = torch.where(up, longer, 1.0)
        wide = up.unsqueeze(-1)
        place = torch.where(wide, there, place)
        height = torch.where(up, found.log_prob, height)
        here = Slope(
            height,
            torch.where(wide, found.pull, here.pull),
            torch.where(wide, found.stiffness, here.stiffness),
        )
    return place, height
