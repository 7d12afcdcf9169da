"""A density of rotations that is constant in the cells of a grid, as a torch distribution over viewpoints."""

import math
from functools import cache

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import constraints

from framework.distributions.circular import Circular, circular, wrap
from framework.distributions.description import PlainDensity
from framework.distributions.protocol import estimate, exact_estimate, marginal, pick, tempered_density
from framework.distributions.uniform import uniform
from framework.geometry.rotation_grid import cell_of, centres, mean_log_cosine, points_in
from framework.heads.viewpoints import CHART, VOLUME, UniformViewpoints, ViewpointDensity, log_volume

BINS = 360
"""Number of bins of the density of a single angle."""
FEW = 4608
"""Largest number of cells for which a matrix holds the share of each cell that lies in each arc (`_shares`)."""
POINTS = 2**20
"""Number of points in all cells together from which the density of a single angle is computed.

Each cell has the same number of points, and at least 64.
"""


class CellDensity(ViewpointDensity):
    """Azimuth a, elevation e and tilt t of a rotation whose density is constant in each cell of a grid.

    The cells are those of `framework.geometry.rotation_grid` and have equal volumes. With n cells and the probability w
    of the cell of a rotation R, the density is p(R) = n w with respect to the rotation-invariant measure of total mass
    1. log_prob is with respect to da de dt in the chart -π/2 ≤ e ≤ π/2: it is log p(R) + log(cos e / 8π²). It is exact,
    since the probabilities of the cells add up to 1. The density p jumps between cells, and is constant within a cell.

    Args:
        log_weights: log of the probability of each cell, (*batch, cell), nats.
    """

    def __init__(self, log_weights: Float[Tensor, "*batch cell"]) -> None:
        self.log_weights = log_weights
        self.cells = log_weights.shape[-1]
        super().__init__(log_weights.shape[:-1], log_weights.dtype)

    @property
    def mode(self) -> Float[Tensor, "*batch 3"]:
        """Viewpoint at the centre of the most likely cell: the mode of p(R), without regard to the factor cos e."""
        best = self.log_weights.argmax(-1)
        return centres(self.cells).to(best.device)[best].to(self.log_weights.dtype)

    def log_prob(self, value: Float[Tensor, "... 3"]) -> Float[Tensor, "..."]:
        index = cell_of(value.detach(), self.cells)
        shape = torch.broadcast_shapes(index.shape, self.batch_shape)
        weights = self.log_weights.expand(*shape, self.cells)
        log_weight = weights.gather(-1, index.expand(shape).unsqueeze(-1)).squeeze(-1)
        volume = log_volume(value[..., 1].double())
        return (log_weight.double() + math.log(self.cells) + volume).to(self.dtype)

    @torch.no_grad()
    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape)
        weights = self.log_weights.reshape(-1, self.cells).double()
        index = torch.zeros(len(weights), shape.numel(), dtype=torch.int64, device=weights.device)
        if index.numel():
            index = torch.multinomial(weights.exp(), shape.numel(), replacement=True)
        index = index.mT.reshape(shape + self.batch_shape)
        x, y, along = torch.rand(3, *index.shape, dtype=torch.float64, device=index.device)
        return points_in(index, x, y, along, self.cells).to(self.log_weights.dtype)

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Return the entropy, nats, with respect to da de dt; its error is below 1e-4."""
        log_weights = self.log_weights.double()
        cosine = mean_log_cosine(self.cells).to(log_weights.device)
        weights = log_weights.exp()
        # a cell of probability 0 adds nothing
        terms = torch.where(weights > 0, log_weights + cosine, 0.0)
        entropy = math.log(VOLUME) - math.log(self.cells) - (weights * terms).sum(-1)
        return entropy.to(self.log_weights.dtype)


class AngleDensity(PlainDensity):
    """The density of one angle of a `CellDensity`, constant in BINS arcs.

    The probability of an arc is estimated from many points of each cell; the error vanishes in the limit of many
    points. The probabilities of all arcs sum to 1.

    Args:
        log_density: log-density in each arc, (*batch, arc), nats.
        half: True for the elevation, whose arcs divide the range ±π/2.
    """

    def __init__(self, log_density: Float[Tensor, "*batch arc"], half: bool) -> None:
        self.log_density, self.half = log_density, half
        self.length = (math.pi if half else 2 * math.pi) / log_density.shape[-1]
        super().__init__(log_density.shape[:-1], torch.Size((1,)), validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        return Circular((CHART[1],)) if self.half else circular

    def log_prob(self, value: Float[Tensor, "... 1"]) -> Float[Tensor, "..."]:
        index = _arc(value.squeeze(-1), self.half)
        shape = torch.broadcast_shapes(index.shape, self.batch_shape)
        log_density = self.log_density.expand(*shape, self.log_density.shape[-1])
        return log_density.gather(-1, index.expand(shape).unsqueeze(-1)).squeeze(-1)

    @torch.no_grad()
    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        mass = (self.log_density.double().exp() * self.length).cumsum(-1)
        uniform = torch.rand(
            *sample_shape, *self.batch_shape, dtype=torch.float64, device=mass.device
        ).unsqueeze(-1)
        index = (uniform * mass[..., -1:] > mass).sum(-1, keepdim=True)
        place = index + torch.rand_like(uniform)
        return (place * self.length - (math.pi / 2 if self.half else math.pi)).to(self.log_density.dtype)

    @property
    def mode(self) -> Float[Tensor, "*batch 1"]:
        """Middle of the arc with the highest density."""
        best = self.log_density.argmax(-1, keepdim=True)
        low = -math.pi / 2 if self.half else -math.pi
        return (low + (best + 0.5) * self.length).to(self.log_density.dtype)

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Return the entropy, nats."""
        mass = self.log_density.double().exp() * self.length
        terms = torch.where(mass > 0, mass * self.log_density.double(), 0.0)
        return -terms.sum(-1).to(self.log_density.dtype)


def _arc(angle: Tensor, half: bool) -> Tensor:
    """Return the index of the arc in which each angle lies.

    `half` is true for elevations. An elevation outside ±π/2 is replaced by that of the same rotation within ±π/2.
    """
    angle = wrap(angle.double())
    low, length = -math.pi, 2 * math.pi
    if half:
        angle = torch.asin(torch.sin(angle).clamp(-1, 1))
        low, length = -math.pi / 2, math.pi
    return ((angle - low) * (BINS / length)).long().clamp(0, BINS - 1)


@cache
def _arcs(cells: int, index: int) -> Int[Tensor, "point cell"]:
    """Return the index of the arc of one angle at several points of each cell.

    `cells` is the number of cells, and `index` the position of the angle in the viewpoint (azimuth, elevation, tilt).
    The points of all cells together are one sequence of low discrepancy: multiples of the powers of the root g of g⁴ =
    g + 1, modulo 1 (a Kronecker sequence; Niederreiter 1992, §3.1).
    """
    count = max(POINTS // cells, 64)
    root = 1.2207440846057596
    parts = []
    for number in torch.arange(cells * count).split(2**20):
        x, y, along = ((number + 0.5).double() / root**power % 1 for power in (1, 2, 3))
        points = points_in(number // count, x, y, along, cells)
        parts.append(_arc(points[:, index], index == 1).to(torch.int16))
    return torch.cat(parts).reshape(cells, count).T.contiguous()


@cache
def _shares(cells: int, index: int) -> Float[Tensor, "cell arc"]:
    """Return the share of each cell that lies in each arc of one angle, for a grid of few cells.

    `cells` is the number of cells, and `index` the position of the angle in the viewpoint (azimuth, elevation, tilt).
    """
    arcs = _arcs(cells, index).long()
    place = torch.arange(cells) * BINS + arcs
    count = torch.bincount(place.flatten(), minlength=cells * BINS)
    return count.reshape(cells, BINS).double() / len(arcs)


estimate.register(CellDensity, exact_estimate)
estimate.register(AngleDensity, exact_estimate)


@uniform.register
def _(density: CellDensity) -> UniformViewpoints:
    return UniformViewpoints(density.log_weights.new_zeros(()), density.batch_shape)


@marginal.register
def _(density: CellDensity, index: int) -> AngleDensity:
    weights = density.log_weights.detach().reshape(-1, density.cells).double().exp()
    if density.cells <= FEW:
        mass = weights @ _shares(density.cells, index).to(weights)
    else:
        arcs = _arcs(density.cells, index)
        mass = weights.new_zeros(len(weights), BINS)
        for arc in arcs:
            mass.index_add_(1, arc.to(weights.device, torch.int64), weights)
        mass = mass / len(arcs)
    mass = mass.reshape(*density.batch_shape, BINS)
    length = (math.pi if index == 1 else 2 * math.pi) / BINS
    return AngleDensity((mass / length).log().to(density.log_weights.dtype), index == 1)


@pick.register
def _(density: CellDensity, index: Tensor) -> CellDensity:
    weights = density.log_weights
    lead = index.shape[: index.dim() - weights.dim() + 2]
    wide = weights.expand((*lead, *weights.shape))
    chosen = wide.gather(-2, index[..., None, None].expand(*index.shape, 1, density.cells)).squeeze(-2)
    return CellDensity(chosen)


@tempered_density.register
def _(density: CellDensity, temperature: Tensor) -> CellDensity:
    """Return the density with p(R) replaced by p(R)^(1/T), normalised; the factor cos e / 8π² does not change."""
    log_weights = torch.log_softmax(density.log_weights.double() / temperature, -1)
    return CellDensity(log_weights.to(density.log_weights.dtype))
