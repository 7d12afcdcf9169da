"""Decisions under a density: the action with the lowest expected cost."""

import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.checks import refuse_nan
from framework.distributions.circular import Circular
from framework.distributions.circular_moments import circular_moments
from framework.distributions.protocol import arc_length, arc_probability, cdf

NOTHING = 1e-9
"""Threshold below which the mass of an arc that was computed on a grid is rounding error and counts as 0."""


def decide(expected: Float[Tensor, "*batch action"]) -> Int[Tensor, "*batch"]:
    """Return the index of the action with the lowest expected cost, the first of several equal ones.

    Raises:
        UserError: expected costs are NaN.
    """
    refuse_nan(expected.amax(-1).reshape(-1), "expected costs")
    # argmin may return any of several equal costs
    least = expected == expected.amin(-1, keepdim=True)
    return least.int().argmax(-1)


def expected_costs(
    probability: Float[Tensor, "*batch truth"], costs: Float[Tensor, "truth action"]
) -> Float[Tensor, "*batch action"]:
    """Return the expected cost of each action, Σ_truth p(truth) cost(truth, action), float64.

    A truth is a class or region that may be the true one. Probability 0 times an infinite cost counts as 0.
    """
    probability = probability.double().unsqueeze(-1)
    return torch.where(probability == 0, 0.0, probability * costs.double()).sum(-2)


@torch.no_grad()
def decide_by_draws(
    density: Distribution,
    cost: Callable[[str, Tensor], Tensor],
    actions: Sequence[str],
    samples: int = 1000,
) -> tuple[Int[Tensor, "*batch"], Float[Tensor, "*batch action"]]:
    """Return the action with the lowest expected cost under any cost function, and the expected costs of all actions.

    Expected costs are means over draws of the density.

    Args:
        density: density of any kind, batch_shape (*batch).
        cost: (action, targets of shape (samples, *batch, *event)) → costs (samples, *batch). Angles are radians.
        actions: names of the actions.
        samples: number of draws.

    Raises:
        ValueError: there are no actions or no samples, or the costs have a wrong shape.
    """
    if not actions or samples < 1:
        raise ValueError(f"got {len(actions)} actions and {samples} samples, expected at least one of each.")
    draws = density.sample(torch.Size((samples,)))
    expected_shape = (samples, *density.batch_shape)
    columns = []
    for action in actions:
        draw_costs = cost(action, draws)
        if tuple(draw_costs.shape) != expected_shape:
            raise ValueError(
                f"cost({action!r}, targets) returned the shape {tuple(draw_costs.shape)}, expected {expected_shape}: "
                "one cost per "
                "target."
            )
        columns.append(draw_costs.double().mean(0))
    expected = torch.stack(columns, -1)
    return decide(expected), expected


def region_probabilities(
    density: Distribution, edges: Float[Tensor, "edge"], samples: int
) -> Float[Tensor, "batch region"]:
    """Return the probabilities of the regions into which edges divide a line or a circle (see `regions`), float64.

    The probabilities are exact if `protocol.cdf`, `protocol.arc_probability` or `circular_moments` is exact; otherwise
    they are shares of `samples` draws.

    Args:
        density: density of one real number or one angle, batch_shape (batch,).
        edges: edges in ascending order; for an angle, in radians and within one turn.
        samples: number of draws.
    """
    around = isinstance(density.support, Circular)
    probabilities = _arcs(density, edges) if around else _intervals(density, edges)
    if probabilities is not None and not bool(probabilities.isinf().any()):
        return probabilities
    draws = density.sample(torch.Size((samples,))).squeeze(-1)
    count = len(edges) if around else len(edges) + 1
    where = torch.nn.functional.one_hot(regions(draws, edges, around=around), count)
    shares = torch.where(draws.isnan().any(0).unsqueeze(-1), torch.nan, where.double().mean(0))
    return shares if probabilities is None else torch.where(probabilities.isinf(), shares, probabilities)


def regions(value: Tensor, edges: Float[Tensor, "edge"], *, around: bool) -> Int[Tensor, "*shape"]:
    """Return the index of the region in which each value lies; an edge belongs to the region above it.

    On a line (`around` is false), region 0 is below the first edge. On a circle (`around` is true), region 0 begins
    counter-clockwise at the first edge, and the last region ends there.
    """
    if not around:
        return torch.bucketize(value.double().contiguous(), edges, right=True)
    # an angle at an edge may lie below this edge after rounding to float32
    ahead = torch.remainder(arc_length(edges[0], value) + 1e-7, 2 * math.pi)
    return torch.bucketize(ahead, edges - edges[0] + 1e-12, right=True) - 1


def _intervals(density: Distribution, edges: Tensor) -> Tensor | None:
    value = edges.reshape(-1, *(1,) * len(density.batch_shape), 1)
    below = cdf(density, value.expand(-1, *density.batch_shape, 1))
    if below is None:
        return None
    ends = torch.cat([torch.zeros_like(below[:1]), below, torch.ones_like(below[:1])])
    return ends.diff(dim=0).clamp(min=0).movedim(0, -1)


def _arcs(density: Distribution, edges: Tensor) -> Tensor:
    """Return the probabilities of the arcs from each edge to the next, (*batch, edge).

    If a density is too narrow for the grid on which probabilities are computed, its entries are infinite; the caller
    then estimates them from draws.
    """
    shape = torch.Size((len(edges), *density.batch_shape))
    start, end = (
        e.reshape(-1, *(1,) * len(density.batch_shape)).expand(shape) for e in (edges, edges.roll(-1))
    )
    known = arc_probability(density, start.unsqueeze(-1), end.unsqueeze(-1))
    if known is not None:
        return known.movedim(0, -1)
    moments = circular_moments(density)
    probabilities = moments.arc_probability(start, end)
    probabilities = torch.where(probabilities < NOTHING, 0.0, probabilities)
    return torch.where(moments.resolved, probabilities, torch.inf).movedim(0, -1)
