"""The truncated distance field of a normalised cloud on a grid, and back (thesis §6.4.1, §6.5.1)."""

import itertools
import math

from jaxtyping import Float
from torch import Tensor

from framework.errors import DataError
from framework.geometry.clouds import Normalised, cell_centres, denormalised, pad


def truncated_distance(
    clouds: Float[Tensor, "batch points columns"], side: int, truncation: float
) -> Float[Tensor, "batch cells"]:
    """For each of the side³ cells of the cube [-1, 1]³, x slowest, the distance of its centre from the nearest point,
    at most `truncation`, as a share of it: 0 to 1. Differentiable in the clouds.

    Only cells so near to a point are looked at, each point's neighbourhood in turn: what is cut off costs nothing.

    Args:
        clouds: normalised; rows of NaN are padding.
        truncation: in edges of a cell.
    """
    real = ~clouds[..., 0].isnan()
    reach = math.floor(truncation + 1 / 2)
    squares, numbers = [], []  # along each axis, for each step off a point's own cell
    for axis, stride in enumerate((side * side, side, 1)):
        # in edges of a cell, from the cube's corner
        place = (clouds[..., axis].where(real, 0) + 1) / 2 * side
        home = place.detach().floor().clamp(-side - 1, 2 * side + 1)
        cells = [home + step for step in range(-reach, reach + 1)]
        inside = [real & (cell >= 0) & (cell < side) for cell in cells]
        squares.append(
            [
                (place - (cell + 1 / 2)).square().where(there, math.inf)
                for cell, there in zip(cells, inside, strict=True)
            ]
        )
        numbers.append([cell.clamp(0, side - 1).long() * stride for cell in cells])
    square = clouds.new_full((len(clouds), side**3), truncation**2)
    for x, y, z in itertools.product(range(2 * reach + 1), repeat=3):
        # a centre so many cells off is at most half a cell nearer than that
        if sum(max(abs(step - reach) - 1 / 2, 0) ** 2 for step in (x, y, z)) >= truncation**2:
            continue
        number = numbers[0][x] + numbers[1][y] + numbers[2][z]
        found = squares[0][x] + squares[1][y] + squares[2][z]
        if found.requires_grad:
            square = square.scatter_reduce(1, number, found, "amin")
        else:
            square.scatter_reduce_(1, number, found, "amin")
    root = square.where(square > 0, 1).sqrt().where(square > 0, 0)  # the root of 0 has no derivative
    return root / truncation


def decode(
    field: Float[Tensor, "batch cells"], side: int, normalised: Normalised
) -> Float[Tensor, "batch points 3"]:
    """Centres of the cells that are less than the truncation from a point, in the clouds' own units, padded as clouds.

    Raises:
        DataError: there is none, all points of a cloud being outside the cube.
    """
    empty = (field >= 1).all(1).nonzero()
    if len(empty):
        raise DataError(
            f"No cell of cloud {int(empty[0])} is near a point; wanted one at least. All its points are outside of "
            "[-1, 1]³: choose normalise=unit_ball."
        )
    centres = cell_centres(side).to(field)
    points = pad([centres[distance < 1] for distance in field])
    return denormalised(points, normalised.centre, normalised.scale)
