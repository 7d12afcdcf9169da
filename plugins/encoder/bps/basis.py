"""Sets of basis points (thesis eq. 6.3, §6.4.2), which depend only on the parameters of `basis`."""

import math
from collections.abc import Callable
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from framework.errors import ConfigError

Strategy = Literal["ball_uniform", "grid", "ball_grid", "hexagonal"]
# Positions of the origin in the cell of a lattice: at a point, in the middle of a cell, of an edge, of a face. The last
# position is irrational and lies on no symmetry element of the lattice. No two points are equally far from it, so that
# a ball around it can hold any number of points.
CENTRES = (
    (0, 0, 0),
    (1 / 2, 1 / 2, 1 / 2),
    (1 / 2, 0, 0),
    (1 / 2, 1 / 2, 0),
    (2**0.5 - 1.3, 3**0.5 - 1.5, 5**0.5 - 1.9),
)
GAP = 1e-10  # difference below which norms count as equal


def basis(strategy: Strategy, count: int, radius: float, seed: int) -> Float[Tensor, "count 3"]:
    """Return basis points around the origin, float64.

    "ball_uniform": points drawn from the uniform density over the ball. They depend only on `seed`, and a larger set
    begins with the points of a smaller one. "grid": a rectangular grid over the cube [-radius, radius]³ including its
    faces, where x changes slowest. "ball_grid", "hexagonal": the points of a cubic lattice, or of hexagonal close
    packing, that lie in the ball; the lattice is scaled so that `count` points lie in the ball.

    Args:
        strategy: kind of basis.
        count: number of points.
        radius: radius of the ball, or half the edge of the cube.
        seed: seed of "ball_uniform".

    Raises:
        ConfigError: `count` is not the cube of an integer and the strategy is "grid"; or no scale of the lattice gives
            `count` points.
    """
    if strategy == "ball_uniform":
        return torch.from_numpy(_ball_uniform(count, seed) * radius)
    if strategy == "grid":
        return torch.from_numpy(_grid(side(count)) * radius)
    cell, lattice = {"ball_grid": (1.0, _cubic), "hexagonal": (1 / math.sqrt(2), _hexagonal)}[strategy]
    return torch.from_numpy(_in_ball(lattice, cell, count) * radius)


def side(count: int) -> int:
    """Return the number of points along each edge of a cubic grid of `count` points.

    Raises:
        ConfigError: `count` is not the cube of an integer; the message names the nearest cubes.
    """
    below = round(count ** (1 / 3))
    while below**3 > count:
        below -= 1
    if below**3 != count:
        raise ConfigError(
            f"encoder bps: basis=grid requires a cubic number of points, but got points={count}. "
            f"Set points={below**3} ({below}³) or points={(below + 1) ** 3} ({below + 1}³)."
        )
    return below


def _ball_uniform(count: int, seed: int) -> np.ndarray:
    """Return `count` points drawn uniformly from the unit ball, (count, 3).

    Each point is a random direction times u^(1/3), where u is drawn uniformly from [0, 1): the volume of a ball grows
    with the cube of its radius.
    """
    # NumPy guarantees that its legacy generator always gives the same bits. Directions and radii have separate
    # generators, so that a larger set begins with the points of a smaller one.
    direction = np.random.RandomState(seed).normal(size=(count, 3))
    share = np.random.RandomState([seed, 1]).random_sample(count)
    return direction / np.linalg.norm(direction, axis=1, keepdims=True) * np.cbrt(share)[:, None]


def _grid(side: int) -> np.ndarray:
    axis = np.linspace(-1, 1, side) if side > 1 else np.zeros(1)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


def _cubic(reach: int) -> np.ndarray:
    """Return a cubic lattice with distance 1 between neighbours, from -`reach` to `reach` along each axis."""
    axis = np.arange(-reach, reach + 1.0)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


def _hexagonal(reach: int) -> np.ndarray:
    """Return hexagonal close packing with distance 1 between neighbours (Conway & Sloane 1999, §1.3 of ch. 5).

    A layer consists of rows along x, which are √3/2 from each other. The distance between layers is √(2/3). Every
    second layer is shifted so that its points lie above the gaps of the layer below. The lattice contains at least all
    points within `reach` of the origin.
    """
    wide, deep, high = reach, math.ceil(reach / math.sqrt(3 / 4)), math.ceil(reach / math.sqrt(2 / 3))
    axes = [np.arange(-end - 1, end + 2.0) for end in (wide, deep, high)]
    column, row, layer = (part.reshape(-1) for part in np.meshgrid(*axes, indexing="ij"))
    odd = layer % 2
    x = column + (row % 2) / 2 + odd / 2
    y = math.sqrt(3 / 4) * row + math.sqrt(1 / 12) * odd
    return np.stack([x, y, math.sqrt(2 / 3) * layer], 1)


def _in_ball(lattice: Callable[[int], np.ndarray], cell: float, count: int) -> np.ndarray:
    """Return the `count` points of a lattice that lie in the unit ball, for the scale at which exactly `count` do.

    Args:
        lattice: function of a distance; it returns at least all lattice points within this distance of the origin.
        cell: volume per lattice point.
        count: number of points in the ball.

    Raises:
        ConfigError: for none of the centres that are tried do exactly `count` points lie in the ball, because the next
            point is as far from the centre as the last one of them, up to rounding.
    """
    radius = (3 * count * cell / (4 * math.pi)) ** (
        1 / 3
    )  # radius of the ball with the volume of `count` cells
    points = lattice(math.ceil(radius) + 2)
    for centre in CENTRES:
        shifted = points - np.array(centre)
        norm = np.linalg.norm(shifted, axis=1)
        order = np.argsort(norm, kind="stable")[: count + 1]
        last, next_one = norm[order[-2:]]
        if next_one - last > GAP:
            chosen = np.sort(order[:count])  # restores the order of the lattice, x slowest
            return (
                shifted[chosen] * 2 / (last + next_one)
            )  # the ball ends half way between the last point inside and the next one
    raise ConfigError(
        f"encoder bps: no basis of exactly points={count} can be cut from the chosen lattice, because its points "
        f"number {count} and {count + 1}, in order of distance from the centre, are equally far from the centre. Set "
        f"points={count + 1}."
    )
