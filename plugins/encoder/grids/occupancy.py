"""Occupancy grids of point clouds, one of the encodings with which the thesis compares basis point sets."""

from jaxtyping import Float
from torch import Tensor

from framework.geometry.clouds import NormalisedClouds
from plugins.encoder.grids.cells import CellEncoder, chosen_centres

ROUNDING = 1e-6
"""Distance outside [-1, 1] up to which a point still lies in the outermost cell, because norms may round above 1."""


class Occupancy(CellEncoder):
    """Occupancy of the cells of a grid over [-1, 1]³ by points of the normalised cloud (thesis §6.4.1, §6.5.1).

    Features are (1, side, side, side), where x changes slowest, and are 0 or 1 in the clouds' dtype. They have no
    gradient.

    Args:
        input_shape: (points, columns) of the largest cloud; coordinates in the first three columns.
        side: number of cells along each edge.
        normalise: "unit_ball", "robust" or "none" (`framework.geometry.clouds.normalise_clouds`). With "robust", far
            outliers lie in no cell.

    Raises:
        ConfigError: the input is not a cloud.
    """

    bibtex = "maturana2015voxnet"
    by = "encoder occupancy"

    def encode(self, clouds: Float[Tensor, "batch points columns"]) -> Float[Tensor, "batch cells"]:
        """Return the occupancy of the cells."""
        return occupancy(clouds, self.side)


def occupancy(clouds: Float[Tensor, "batch points columns"], side: int) -> Float[Tensor, "batch cells"]:
    """Return the occupancy of the side³ cells of the cube [-1, 1]³: 1 if a point lies in the cell, else 0.

    In the order of the cells, x changes slowest. A cell includes its lower faces; the last cell of a row includes its
    upper face too. Points outside the cube lie in no cell.

    Args:
        clouds: normalised clouds; rows of NaN are padding.
        side: number of cells along each edge.
    """
    coordinates = clouds[..., :3].detach()
    inside = (coordinates.abs() <= 1 + ROUNDING).all(-1)  # False for NaN
    position = ((coordinates.double() + 1) / 2 * side).nan_to_num(0, 0, 0).clamp(0, side - 1).long()
    cell = (position[..., 0] * side + position[..., 1]) * side + position[..., 2]
    cell = cell.where(inside, side**3)  # an extra cell collects the points that lie in no cell
    occupied = coordinates.new_zeros(clouds.shape[0], side**3 + 1)
    return occupied.scatter_(1, cell, 1.0)[:, :-1]


def decode(
    occupied: Float[Tensor, "batch cells"], side: int, normalised: NormalisedClouds
) -> Float[Tensor, "batch points 3"]:
    """Return the centres of the occupied cells in the clouds' own units, padded with rows of NaN.

    Args:
        occupied: occupancy of the cells, as `occupancy` returns it.
        side: number of cells along each edge.
        normalised: the encoded clouds, whose centre and scale convert the centres to the clouds' units.

    Raises:
        DataError: no cell of a cloud is occupied.
    """
    return chosen_centres(occupied > 0, occupied, side, normalised, "occupied")
