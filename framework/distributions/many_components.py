"""Candidates for the mode of a mixture of very many components over one number, in time n log n for n components.

The density of the mixture at the modes of all n components is a sum of n² terms. Here the components are sorted into
levels by their width. The sum of the components of one level is a smooth function, which is computed on a grid of nodes
near these components, and interpolated (as in fast Gauss transforms, Greengard & Strain 1991).
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular
from framework.distributions.protocol import peak_widths, quadratic_bound, recentre

FEWEST = 2048
"""Smallest number of components for which the interpolation is used; fewer components are summed faster directly."""
KEPT = 64
"""Number of candidates that are kept; the density at these is computed exactly afterwards."""
NODES = 4
"""Smallest number of nodes over the width of a component; the largest number is twice as large."""
REACH = 64
"""Number of nodes on each side of a component: at least 8 widths, where a normal density has fallen by a factor e³²."""
BLOCK = 7
"""Number of binary digits of a node's index within its block; memory is reserved for whole blocks of nodes."""
COARSEST = 8
"""Coarsest level of a circle, with 2⁸ nodes; components of this level are wide, and are computed at all these nodes."""
FINEST = 2.0**36
"""Largest index of a node; at larger indices, rounding would shift the positions of nodes relative to components."""
AT_ONCE = 2**13
"""Number of components that are evaluated at once."""


@torch.no_grad()
def likeliest_modes(
    components: Distribution, log_weights: Float[Tensor, "*batch K"], modes: Float[Tensor, "K *batch 1"]
) -> Float[Tensor, "kept *batch 1"] | None:
    """Return those modes of components at which a mixture is highest, or None if they are not found by interpolation.

    The log-density of the mixture at the modes is interpolated with an error of about 1e-4 nats. The best mode may
    therefore be missing if the log-density there exceeds that at a returned mode by less than this error.

    Args:
        components: a density of one number with batch_shape (*batch, K), with K modes for each item of the batch. If
            its `quadratic_bound` is not known, its smoothness is not known either, and the result is None.
        log_weights: logarithms of the weights, nats.
        modes: mode of each component.
    """
    if quadratic_bound(components, modes.movedim(0, -2)) is None:
        return None
    widths = peak_widths(components).double().reshape(-1, log_weights.shape[-1])
    places = modes.double().movedim(0, -2).reshape(-1, log_weights.shape[-1])
    circle = isinstance(components.support, Circular)
    kept = []
    batch = components.batch_shape[:-1]
    for item, (weights, place, width) in enumerate(
        zip(log_weights.double().reshape(places.shape), places, widths, strict=True)
    ):
        index = torch.unravel_index(torch.tensor(item, device=place.device), batch)
        heights = _heights(components, index, weights, place, width, circle)
        if heights is None:
            return None
        kept.append(heights.topk(min(KEPT, len(heights))).indices)
    chosen = torch.stack(kept, 1).reshape(-1, *batch, 1)
    return modes.gather(0, chosen)


def _heights(
    components: Distribution,
    index: tuple[Tensor, ...],
    log_weights: Tensor,
    place: Tensor,
    width: Tensor,
    circle: bool,
) -> Tensor | None:
    """Return the interpolated density of a mixture at each mode, for one item of the batch, up to a common factor.

    The result is None if the density cannot be interpolated.

    Args:
        components: the components, with batch_shape (*batch, K).
        index: index of the item, one tensor for each batch dimension before K.
        log_weights: logarithms of the weights, (K,), nats.
        place: mode of each component, (K,).
        width: peak width of each component, (K,).
        circle: true if the number is an angle.
    """
    if not bool((width.isfinite() & (width > 0) & place.isfinite()).all()):
        return None
    unit = 2 * math.pi if circle else 1.0
    if circle:
        place = torch.remainder(place, unit)
    level = torch.ceil(torch.log2(NODES * unit / width)).to(torch.int64)
    if circle:
        level = level.clamp(min=COARSEST)
    spacing = unit * torch.exp2(-level.double())
    if bool((place.abs() / spacing.min() > FINEST).any()):
        return None
    node = torch.floor(place / spacing).to(torch.int64)
    grid = _Grid.around(level, node, circle)
    # terms relative to the highest peak of a component
    scale = log_weights - (log_weights - width.log()).max()
    for some in torch.arange(len(place), device=place.device).split(AT_ONCE):
        wide = circle & (level[some] == COARSEST)
        # a wide component is evaluated once at every node of the circle
        for chosen, reach in ((wide, 2**COARSEST // 2), (~wide, REACH)):
            members = some[chosen]
            if not len(members):
                continue
            part = recentre(components, (*index, members), place[members].unsqueeze(-1))
            steps = torch.arange(-reach, reach, device=place.device).unsqueeze(-1)
            numbers = node[members] + steps
            offsets = numbers * spacing[members] - place[members]
            terms = (scale[members] + part.log_prob(offsets.unsqueeze(-1))).exp()
            grid.add(level[members], numbers, terms)
    total = torch.zeros_like(place)
    for each in level.unique():
        position = place / (unit * torch.exp2(-each.double()))
        total += grid.interpolate(each, position)
    return total


class _Grid:
    """Grid of nodes for each level; a node holds the weighted sum of the densities of the level's components.

    Consecutive nodes form blocks of 2**BLOCK nodes. A block has memory only if a component has nodes in it.
    """

    def __init__(self, keys: Tensor, circle: bool) -> None:
        self.keys = keys
        self.circle = circle
        # the last block stays empty; it stands for all that have no memory
        self.sums = torch.zeros((len(keys) + 1) << BLOCK, dtype=torch.float64, device=keys.device)

    @classmethod
    def around(cls, level: Tensor, node: Tensor, circle: bool) -> "_Grid":
        """Return an empty grid with memory for each node whose number differs by at most REACH from one of `node`."""
        steps = torch.tensor([[-REACH], [0], [REACH]], device=node.device)
        keys = cls.key(level, node + steps, circle).unique()
        if circle:
            every = torch.arange(2 ** (COARSEST - BLOCK), device=node.device) << BLOCK
            keys = torch.cat(
                [keys, cls.key(torch.tensor(COARSEST, device=node.device), every, True)]
            ).unique()
        return cls(keys, circle)

    @staticmethod
    def key(level: Tensor, number: Tensor, circle: bool) -> Tensor:
        """Return a number that identifies the block of a node."""
        if circle:
            number = number & ((1 << level) - 1)
        # blocks of one level have numbers below 2^38 in magnitude
        return (level << 40) + (number >> BLOCK)

    def slot(self, level: Tensor, number: Tensor) -> Tensor:
        """Return the indices in `sums` of the nodes `number` of a level."""
        key = self.key(level, number, self.circle)
        rank = torch.searchsorted(self.keys, key)
        known = self.keys[rank.clamp(max=len(self.keys) - 1)] == key
        rank = torch.where(known, rank, len(self.keys))
        return (rank << BLOCK) + (number & ((1 << BLOCK) - 1))

    def add(self, level: Tensor, number: Tensor, terms: Tensor) -> None:
        """Add terms, (step, component), to the sums at the nodes `number`.

        The nodes of a component have consecutive numbers.
        """
        # at most three blocks are searched for each component, not the block of every node
        first = number[0] >> BLOCK
        blocks = (first + torch.arange(3, device=number.device).unsqueeze(-1)) << BLOCK
        starts = self.slot(level, blocks)
        slots = starts.gather(0, (number >> BLOCK) - first) + (number & ((1 << BLOCK) - 1))
        self.sums.index_add_(0, slots.flatten(), terms.flatten())

    def interpolate(self, level: Tensor, position: Tensor) -> Tensor:
        """Return the sum of one level, interpolated at each position from six nodes (Lagrange).

        Positions are in units of the distance between the nodes of the level.
        """
        first = torch.floor(position)
        part = position - first
        total = torch.zeros_like(position)
        for step in range(-2, 4):
            weight = torch.ones_like(part)
            for other in range(-2, 4):
                if other != step:
                    weight = weight * (part - other) / (step - other)
            total += weight * self.sums[self.slot(level, first.to(torch.int64) + step)]
        return total
