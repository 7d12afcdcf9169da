"""Search for the highest point of a density, uphill from several starting points."""

import math

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular, wrap
from framework.distributions.protocol import QuadraticBound, quadratic_bound

STARTS = 3
"""Number of starting points from which the search goes uphill; the density is higher at these than at the others."""
STEPS = 16
"""Largest number of steps from one starting point."""
LONGEST = 16.0
"""Longest step, as a multiple of the step to the maximum of the quadratic lower bound (`quadratic_bound`)."""
SCALES = 48
"""Number of distances from a starting point, each √½ of the previous one, at which `_search` evaluates the density."""
SECTIONS = 60
"""Number of golden-section steps of `_search`, which narrow a bracket to less than 1e-9 of its width."""
GOLDEN = (3 - math.sqrt(5)) / 2
"""Share of an interval at which a golden-section step divides it."""


def highest(density: Distribution, starts: Tensor) -> Tensor:
    """Return a point (*batch, *event) where the density is at least as high as at all starting points.

    If the `quadratic_bound` of the density is known, the point is a local maximum, up to the rounding of log_prob and
    unless more than STEPS steps are needed. It is not the global maximum if no ascent from a starting point leads
    there. If the `quadratic_bound` is not known, the point is a local maximum for a density of one number, which is
    found by golden section, and for a density of several numbers the starting point with the highest density.

    Args:
        density: the density.
        starts: starting points, (start, *batch, *event).
    """
    height, which = density.log_prob(starts).topk(min(STARTS, len(starts)), 0)
    highest_starts = starts.gather(0, _over_event(density, which))
    if density.event_shape.numel() == 1 and quadratic_bound(density, highest_starts) is None:
        top, height = _search(density, highest_starts, height, starts)
    else:
        top, height = _climb(density, highest_starts, height)
    return top.gather(0, _over_event(density, height.argmax(0, keepdim=True))).squeeze(0)


def crossings(components: Distribution, modes: Tensor) -> Tensor:
    """Return starting points between every two of K components, for the search for a mixture's mode.

    Two components that are narrow along different coordinates may together be highest at a point far from both of their
    modes. The starting point for such a pair is the maximum of the product of two quadratic bounds: of the first
    component and of the second, both at the mode of the first.

    Args:
        components: a density with batch_shape (*batch, K).
        modes: modes of the components, (K, *batch, *event).

    Returns:
        Points (pair, *batch, *event); no pair if the `quadratic_bound` of the components is not known.
    """
    # (K, *batch, K, *event): the second component at the first's mode
    both = quadratic_bound(components, modes.unsqueeze(-2))
    if both is None:
        return modes[:0]
    own = both.stiffness.diagonal(dim1=0, dim2=-2).movedim(-1, 0).unsqueeze(-2)
    step = _step_to_top(both.pull, both.stiffness + own, isinstance(components.support, Circular))
    return (modes.unsqueeze(-2) + step).movedim(-2, 0).flatten(0, 1)


def _step_to_top(pull: Tensor, stiffness: Tensor, angles: bool) -> Tensor:
    """Return the step from the point where a `QuadraticBound` touches the density to the maximum of the bound.

    The step is 0 where it is not finite.

    Args:
        pull: gradient of the bound at that point (`QuadraticBound.pull`).
        stiffness: curvature of the bound (`QuadraticBound.stiffness`).
        angles: true if the numbers are angles.
    """
    return (torch.atan2(pull, stiffness) if angles else pull / stiffness).nan_to_num(0.0, 0.0, 0.0)


def _over_event(density: Distribution, index: Tensor) -> Tensor:
    event = density.event_shape
    return index.reshape(*index.shape, *(1,) * len(event)).expand(*index.shape, *event)


@torch.no_grad()
def _climb(density: Distribution, point: Tensor, height: Tensor) -> tuple[Tensor, Tensor]:
    """Return a local maximum for each starting point, (start, *batch, *event), and the log-densities there.

    Each step leads towards the maximum of the quadratic bound, where the density is at least as high. The step is
    lengthened by a factor that follows from the gradients before and after the previous step (the secant method). For
    one number this is Newton's method near the maximum, without a second derivative. If the bound is not known, the
    starting points are returned.

    Args:
        density: the density.
        point: starting points, (start, *batch, *event).
        height: log-densities at the starting points, (start, *batch).
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


@torch.no_grad()
def _search(density: Distribution, point: Tensor, height: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
    """Return a local maximum near each point for a density of one number, and the log-densities there.

    The density is evaluated at distances of all orders of magnitude from each point, up to the farthest of the starting
    points. The highest of these values and its two neighbours bracket a maximum, which a golden-section search narrows
    (Kiefer 1953). A point stays unchanged where the gain is within the rounding of log_prob.

    Args:
        density: the density.
        point: points where the search starts, (point, *batch, *event).
        height: log-densities at these points, (point, *batch).
        starts: all starting points, (start, *batch, *event).
    """
    angles = isinstance(density.support, Circular)

    def evaluate(offset: Tensor) -> Tensor:
        place = point + offset.reshape(*offset.shape, *(1,) * len(density.event_shape))
        return density.log_prob(wrap(place) if angles else place)

    away = starts.unsqueeze(1) - point
    reach = (wrap(away) if angles else away).abs().amax(0).reshape(height.shape)
    scales = 2.0 ** (-torch.arange(SCALES, dtype=point.dtype, device=point.device) / 2)
    ascending = torch.cat([-scales, torch.zeros_like(scales[:1]), scales.flip(0)])
    offsets = ascending.reshape(-1, *(1,) * reach.dim()) * reach
    heights = torch.stack([evaluate(offset) for offset in offsets])
    heights[SCALES] = height
    best = heights.argmax(0, keepdim=True)
    top = heights.gather(0, best).squeeze(0)
    low, middle, high = (
        offsets.gather(0, (best + side).clamp(0, 2 * SCALES)).squeeze(0) for side in (-1, 0, 1)
    )
    for _ in range(SECTIONS):
        upper = high - middle >= middle - low
        probe = middle + GOLDEN * torch.where(upper, high - middle, low - middle)
        probed = evaluate(probe)
        better = probed > top
        # the better one of the two inner points becomes the middle, the other one an end
        inner, outer = torch.where(better, probe, middle), torch.where(better, middle, probe)
        low, high = torch.where(better == upper, outer, low), torch.where(better == upper, high, outer)
        middle, top = inner, torch.where(better, probed, top)
    least = 4 * torch.finfo(height.dtype).eps
    gained = top - height > least * height.abs().clamp(min=1)
    moved = point + middle.reshape(point.shape)
    moved = wrap(moved) if angles else moved
    return torch.where(gained.reshape(point.shape), moved, point), torch.where(gained, top, height)
