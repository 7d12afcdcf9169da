"""Occupancy of the cells of a grid by a normalised cloud, and back (thesis §6.4.1)."""

from jaxtyping import Float
from torch import Tensor

from framework.errors import DataError
from framework.geometry.clouds import Normalised, cell_centres, denormalised, pad

ROUNDING = 1e-6
"""A point may be so far outside of [-1, 1] and lie in the cell at the edge: rounding puts a norm above 1."""


def occupancy(clouds: Float[Tensor, "batch points columns"], side: int) -> Float[Tensor, "batch cells"]:
    """1 for each of the side³ cells of the cube [-1, 1]³, x slowest, that a point lies in, 0 for the others.

    A cell holds its lower faces, the last one of a row its upper too. Points outside the cube lie in no cell.

    Args:
        clouds: normalised; rows of NaN are padding.
    """
    coordinates = clouds[..., :3].detach()
    inside = (coordinates.abs() <= 1 + ROUNDING).all(-1)  # not where NaN
    place = ((coordinates.double() + 1) / 2 * side).nan_to_num(0, 0, 0).clamp(0, side - 1).long()
    cell = (place[..., 0] * side + place[..., 1]) * side + place[..., 2]
    cell = cell.where(inside, side**3)  # a cell more, for points of no cell
    flags = coordinates.new_zeros(len(clouds), side**3 + 1)
    return flags.scatter_(1, cell, 1.0)[:, :-1]


def decode(
    flags: Float[Tensor, "batch cells"], side: int, normalised: Normalised
) -> Float[Tensor, "batch points 3"]:
    """Centres of the occupied cells in the clouds' own units (§6.4.1), padded as clouds are.

    Args:
        normalised: of the clouds that were encoded; its centre and scale lead back.

    Raises:
        DataError: no cell of a cloud is occupied, all its points being outside the cube.
    """
    empty = (flags == 0).all(1).nonzero()
    if len(empty):
        raise DataError(
            f"No cell of cloud {int(empty[0])} is occupied; wanted one at least. All its points are outside of "
            "[-1, 1]³: choose normalise=unit_ball."
        )
    centres = cell_centres(side).to(flags)
    points = pad([centres[occupied > 0] for occupied in flags])
    return denormalised(points, normalised.centre, normalised.scale)
