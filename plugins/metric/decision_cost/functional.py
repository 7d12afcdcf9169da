"""Decisions under a density: the action of least expected cost."""

import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.checks import refuse_nan
from framework.distributions.circular import Circular
from framework.distributions.circular_moments import circular_moments
from framework.distributions.protocol import arc, cdf, turn

NOTHING = 1e-9
"""Masses of arcs from a grid below this are rounding, and count as 0: no cost is so large that it may decide."""


def decide(expected: Float[Tensor, "*batch action"]) -> Int[Tensor, "*batch"]:
    """The action of least expected cost, the first of equals.

    Raises:
        UserError: costs that are NaN, under which nothing can be decided; says how many.
    """
    refuse_nan(expected.amax(-1).reshape(-1), "expected costs")
    # argmin may give any of equals
    least = expected == expected.amin(-1, keepdim=True)
    return least.int().argmax(-1)


def expected_costs(
    probability: Float[Tensor, "*batch truth"], costs: Float[Tensor, "truth action"]
) -> Float[Tensor, "*batch action"]:
    """Σ_truth p(truth) cost(truth, action), float64; what has probability 0 costs 0, though its cost be infinite."""
    probability = probability.double().unsqueeze(-1)
    return torch.where(probability == 0, 0.0, probability * costs.double()).sum(-2)


@torch.no_grad()
def decide_by_draws(
    density: Distribution,
    cost: Callable[[str, Tensor], Tensor],
    actions: Sequence[str],
    samples: int = 1000,
) -> tuple[Int[Tensor, "*batch"], Float[Tensor, "*batch action"]]:
    """Decisions under any cost function, and the expected costs: means over `samples` draws of the density.

    Args:
        density: of any kind, batch_shape (*batch).
        cost: (action, targets of shape (samples, *batch, *event)) → costs (samples, *batch). Angles are radians.

    Raises:
        ValueError: no actions, no samples, or costs of another shape.
    """
    if not actions or samples < 1:
        raise ValueError(f"wanted an action and a sample at least, got {len(actions)} and {samples}.")
    drawn = density.sample(torch.Size((samples,)))
    wanted = (samples, *density.batch_shape)
    columns = []
    for action in actions:
        found = cost(action, drawn)
        if tuple(found.shape) != wanted:
            raise ValueError(
                f"cost({action!r}, targets) came with shape {tuple(found.shape)}; wanted {wanted}, one cost a target."
            )
        columns.append(found.double().mean(0))
    expected = torch.stack(columns, -1)
    return decide(expected), expected


def region_probabilities(
    density: Distribution, edges: Float[Tensor, "edge"], samples: int
) -> Float[Tensor, "batch region"]:
    """Masses of the regions that edges cut a line or a circle into, float64; see `regions`.

    Exact where `protocol.cdf`, `protocol.arc` or `circular_moments` are, otherwise shares of `samples` draws.

    Args:
        density: of one real or one angle, batch_shape (batch,).
        edges: ascending; of an angle radians, within one turn.
    """
    around = isinstance(density.support, Circular)
    found = _arcs(density, edges) if around else _intervals(density, edges)
    if found is not None and not bool(found.isinf().any()):
        return found
    drawn = density.sample(torch.Size((samples,))).squeeze(-1)
    count = len(edges) if around else len(edges) + 1
    where = torch.nn.functional.one_hot(regions(drawn, edges, around=around), count)
    shares = torch.where(drawn.isnan().any(0).unsqueeze(-1), torch.nan, where.double().mean(0))
    return shares if found is None else torch.where(found.isinf(), shares, found)


def regions(value: Tensor, edges: Float[Tensor, "edge"], *, around: bool) -> Int[Tensor, "*shape"]:
    """Which region each value lies in, an edge belonging to the region above it.

    Of a line below the first edge is region 0. Of a circle region 0 begins at the first edge, counter-clockwise, and
    the last ends there.
    """
    if not around:
        return torch.bucketize(value.double().contiguous(), edges, right=True)
    # radians in float32 may stand a rounding before the edge that they were made of
    ahead = torch.remainder(turn(edges[0], value) + 1e-7, 2 * math.pi)
    return torch.bucketize(ahead, edges - edges[0] + 1e-12, right=True) - 1


def _intervals(density: Distribution, edges: Tensor) -> Tensor | None:
    value = edges.reshape(-1, *(1,) * len(density.batch_shape), 1)
    below = cdf(density, value.expand(-1, *density.batch_shape, 1))
    if below is None:
        return None
    ends = torch.cat([torch.zeros_like(below[:1]), below, torch.ones_like(below[:1])])
    return ends.diff(dim=0).clamp(min=0).movedim(0, -1)


def _arcs(density: Distribution, edges: Tensor) -> Tensor:
    """Infinite where a density is too narrow for the grid."""
    shape = torch.Size((len(edges), *density.batch_shape))
    start, end = (
        e.reshape(-1, *(1,) * len(density.batch_shape)).expand(shape) for e in (edges, edges.roll(-1))
    )
    known = arc(density, start.unsqueeze(-1), end.unsqueeze(-1))
    if known is not None:
        return known.movedim(0, -1)
    seen = circular_moments(density)
    found = seen.arc(start, end)
    found = torch.where(found < NOTHING, 0.0, found)
    return torch.where(seen.resolved, found, torch.inf).movedim(0, -1)
