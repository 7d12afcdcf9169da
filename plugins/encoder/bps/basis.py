"""Sets of basis points (thesis eq. 6.3, §6.4.2), each a function of its parameters alone."""

import math
from collections.abc import Callable
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from framework.errors import ConfigError

Strategy = Literal["ball_uniform", "grid", "ball_grid", "hexagonal"]
# Positions of the origin in the cell of a lattice: at a point, in the middle of a cell, an edge, a face. The last
# position is on no symmetry (irrational): no two points are equally far from it, so that a ball can hold any number.
CENTRES = (
    (0, 0, 0),
    (1 / 2, 1 / 2, 1 / 2),
    (1 / 2, 0, 0),
    (1 / 2, 1 / 2, 0),
    (2**0.5 - 1.3, 3**0.5 - 1.5, 5**0.5 - 1.9),
)
GAP = 1e-10  # norms that differ by less count as equal


def basis(strategy: Strategy, count: int, radius: float, seed: int) -> Float[Tensor, "count 3"]:
    """Return basis points around the origin, float64.

    "ball_uniform": drawn from the uniform density over the ball; they depend on `seed` alone, and a larger set begins
    with the points of a smaller one. "grid": a rectangular grid over the cube [-radius, radius]³, its faces included, x
    slowest. "ball_grid", "hexagonal": the points of a cubic lattice, or of hexagonal close packing, that lie in the
    ball; the lattice is scaled so that their number is `count`.

    Raises:
        ConfigError: `count` is no cube and the strategy is "grid"; or no lattice can be scaled to `count`.
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
        ConfigError: `count` is no cube; the message names the nearest ones.
    """
    below = round(count ** (1 / 3))
    while below**3 > count:
        below -= 1
    if below**3 != count:
        raise ConfigError(
            f"encoder bps: basis=grid has as many points as a cube, got points={count}; "
            f"write points={below**3} ({below}³) or points={(below + 1) ** 3} ({below + 1}³)."
        )
    return below


def _ball_uniform(count: int, seed: int) -> np.ndarray:
    """Return random directions at radii u^(1/3), since the volume within a radius grows with its cube."""
    # NumPy guarantees that its legacy generator always gives the same bits. There are two generators, so that a larger
    # set begins with the points of a smaller one.
    direction = np.random.RandomState(seed).normal(size=(count, 3))
    share = np.random.RandomState([seed, 1]).random_sample(count)
    return direction / np.linalg.norm(direction, axis=1, keepdims=True) * np.cbrt(share)[:, None]


def _grid(side: int) -> np.ndarray:
    axis = np.linspace(-1, 1, side) if side > 1 else np.zeros(1)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


def _cubic(reach: int) -> np.ndarray:
    """Return a cubic lattice with distance 1 between neighbours, from -reach to reach along each axis."""
    axis = np.arange(-reach, reach + 1.0)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


def _hexagonal(reach: int) -> np.ndarray:
    """Return hexagonal close packing with distance 1 between neighbours (Conway & Sloane 1999, §1.3 of ch. 5).

    Rows along x at distance √3/2 make a layer. Layers have distance √(2/3). Every second layer is shifted so that its
    points lie above the gaps of the layer below.
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
        lattice: function that returns all lattice points within a distance of the origin, and more.
        cell: volume per lattice point.
        count: number of points in the ball.

    Raises:
        ConfigError: for every position of the origin, two points that are equally far would be in and out.
    """
    radius = (3 * count * cell / (4 * math.pi)) ** (1 / 3)  # of the ball with the volume of `count` cells
    points = lattice(math.ceil(radius) + 2)
    for centre in CENTRES:
        about = points - np.array(centre)
        norm = np.linalg.norm(about, axis=1)
        order = np.argsort(norm, kind="stable")[: count + 1]
        last, next_one = norm[order[-2:]]
        if next_one - last > GAP:
            chosen = np.sort(order[:count])  # restores the order of the lattice, x slowest
            return (
                about[chosen] * 2 / (last + next_one)
            )  # the ball ends half way between the last point inside and the next one
    raise ConfigError(
        f"encoder bps: no ball holds exactly points={count} of this lattice, to rounding; write points={count + 1}."
    )
