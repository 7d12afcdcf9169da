"""Integrals of any density over cells of its domain: on a fixed grid, or by adaptive quadrature for three angles."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular
from framework.testing.three_angles import cells_of_three_angles

POINTS = {1: 1020, 2: 504}
"""Grid points per side, by the number of angles; the error is negligible for densities that the grid resolves."""
REAL_POINTS = {1: 1020, 2: 252, 3: 72}
"""Grid points per side, by the number of real numbers."""
CELLS = {1: 12, 2: 12, 3: 6}
"""Cells per side in which draws are counted, by the number of angles or real numbers; a divisor of the grid points."""
REAL_SCALE = 3.0
"""Scale c of the map x = c tan(t/2) from the circle to the real line; half of the grid points lie within ±c."""


def cells(density: Distribution) -> tuple[list[Tensor], Tensor]:
    """Return the borders of cells along each number, (cells per side + 1,), and their masses (*cells, *batch), float64.

    The density may be over one to three numbers or over classes; the borders of classes lie between their indices.

    Raises:
        ValueError: The density has more than three numbers.
    """
    batch = density.batch_shape
    if density.event_shape == ():
        classes = density.enumerate_support()
        return [torch.arange(len(classes) + 1) - 0.5], density.log_prob(classes).double().exp()
    numbers = density.event_shape[0]
    if numbers not in CELLS:
        raise ValueError(
            f"Got a density of {numbers} numbers, but only the domains of one to three numbers are divided into cells. "
            "Pass a marginal density."
        )
    if numbers == 3 and isinstance(density.support, Circular):
        return cells_of_three_angles(density, CELLS[numbers])
    points = (POINTS if isinstance(density.support, Circular) else REAL_POINTS)[numbers]
    count = CELLS[numbers]
    sides = [side(density, index, points, count) for index in range(numbers)]
    axes = torch.meshgrid(*[axis for axis, _, _ in sides], indexing="ij")
    weight = torch.stack(torch.meshgrid(*[slope for _, slope, _ in sides], indexing="ij")).prod(0)
    mass = density_at(density, torch.stack(axes, -1).reshape(-1, numbers))
    mass = mass * weight.reshape(-1, *(1,) * len(batch))
    mass = mass.reshape(*(count, points // count) * numbers, *batch)
    return [borders for _, _, borders in sides], mass.sum(tuple(range(1, 2 * numbers, 2)))


@dataclass(frozen=True)
class DrawnGrid:
    """Grid of cells over real numbers whose centre, width and correlation are those of draws, for each batch row.

    Draws that lie far from the others change the width little.

    Attributes:
        borders: Borders of the cells along each number of a standardised value, (cells per side + 1,).
        mass: Integral of the density over each cell, (*cells, *batch), float64.
        centre: (*batch, number), float64.
        root: Upper triangular matrix R, (*batch, number, number): a value is centre + Rᵀ · (standardised value).
    """

    borders: list[Tensor]
    mass: Tensor
    centre: Tensor
    root: Tensor

    def standardise(self, value: Tensor) -> Tensor:
        """Return (Rᵀ)⁻¹ (value - centre) for values, (draws, *batch, number), with the matrix R = `root`."""
        offset = (value.double() - self.centre).movedim(0, -1)
        return torch.linalg.solve_triangular(self.root.mT, offset, upper=False).movedim(-1, 0)


def cells_around_draws(density: Distribution) -> DrawnGrid:
    """Return cells of a density of two or three real numbers, on a grid that new draws from the density determine."""
    numbers = density.event_shape[0]
    draws = density.sample(torch.Size((4096,))).double()
    low, centre, high = (draws.quantile(share, 0) for share in (0.16, 0.5, 0.84))
    offset = draws - centre
    most = 5 * (high - low)
    _, root = torch.linalg.qr(offset.clamp(-most, most).movedim(0, -2) / len(draws) ** 0.5)
    points, count = REAL_POINTS[numbers], CELLS[numbers]
    axis, slope, border = side(density, 0, points, count)
    node = torch.cartesian_prod(*[axis] * numbers)
    weight = torch.cartesian_prod(*[slope] * numbers).prod(-1)
    dtype = density.sample(torch.Size((0,))).dtype
    mass = []
    for part, share in zip(node.split(2**14), weight.split(2**14), strict=True):
        value = centre + torch.einsum("pi,...ij->p...j", part, root)
        density_there = density.log_prob(value.to(dtype)).double().exp()
        mass.append(density_there * share.reshape(-1, *(1,) * len(density.batch_shape)))
    volume = root.diagonal(dim1=-2, dim2=-1).abs().prod(-1)
    whole = (torch.cat(mass) * volume).reshape(*(count, points // count) * numbers, *density.batch_shape)
    return DrawnGrid([border] * numbers, whole.sum(tuple(range(1, 2 * numbers, 2))), centre, root)


def density_at(density: Distribution, points: Tensor) -> Tensor:
    """Return the density, (points, *batch) float64, at points (points, numbers)."""
    batch = density.batch_shape
    like = density.sample(torch.Size((0,)))  # an empty sample has the dtype of the density
    value = points.to(like.dtype).reshape(-1, *(1,) * len(batch), points.shape[-1])
    return density.log_prob(value.expand(-1, *batch, -1)).double().exp()


def count_samples(density: Distribution, borders: list[Tensor], samples: Tensor) -> Tensor:
    """Return the number of samples in each cell, (*cells, *batch) float64.

    Args:
        density: Density from which the samples were drawn.
        borders: Borders of the cells along each number, as `cells` returns them.
        samples: Samples, (draws, *batch, *event).
    """
    batch = density.batch_shape
    if density.event_shape == ():
        labels = torch.arange(len(borders[0]) - 1).reshape(-1, *(1,) * samples.dim())
        return (samples == labels).double().sum(1)
    sides = [len(border) - 1 for border in borders]
    cell = torch.zeros(samples.shape[:-1], dtype=torch.int64)
    for number, (border, side) in enumerate(zip(borders, sides, strict=True)):
        coordinate = samples[..., number].double()
        if isinstance(density.support, Circular):
            coordinate = torch.remainder(coordinate + math.pi, 2 * math.pi) - math.pi
        cell = cell * side + torch.bucketize(coordinate.contiguous(), border[1:-1])
    counts = torch.zeros(math.prod(sides), *batch, dtype=torch.float64)
    counts.scatter_add_(0, cell, torch.ones_like(cell, dtype=torch.float64))
    return counts.reshape(*sides, *batch)


def side(density: Distribution, index: int, points: int, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the nodes and weights of a quadrature along one number of the density, and borders of cells.

    Nodes over a whole turn are equally spaced. A range that is shorter than a turn has Gauss-Legendre nodes in each
    cell, since the density may differ at its two ends.

    Args:
        density: Density of real numbers or angles.
        index: Position of the number in the target.
        points: Number of nodes.
        count: Number of cells.

    Returns:
        Nodes (points,), weights (points,) and borders of the cells (count + 1,), ascending.
    """
    middle = (torch.arange(points, dtype=torch.float64) + 0.5) / points
    border = torch.arange(count + 1, dtype=torch.float64) / count
    if isinstance(density.support, Circular):
        ranges = density.support.ranges
        low, high = (-math.pi, math.pi) if ranges is None else ranges[index]
        length = high - low
        weight = torch.full_like(middle, 1 / points)
        if ranges is not None:
            node, half = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(points // count))
            middle = (border[:-1, None] + (node + 1) / (2 * count)).flatten()
            weight = (half / (2 * count)).repeat(count)
        return low + length * middle, length * weight, low + length * border
    axis, border = _real(middle), _real(border)
    border[0], border[-1] = -math.inf, math.inf
    return axis, math.pi * REAL_SCALE * (1 + (axis / REAL_SCALE).square()) / points, border


def _real(part: Tensor) -> Tensor:
    """Map numbers t in (0, 1) to the real line: c tan(π (t - 1/2)) with c = REAL_SCALE."""
    return REAL_SCALE * torch.tan(math.pi * (part - 0.5))
