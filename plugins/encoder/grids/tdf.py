"""Truncated distance fields of point clouds, with which the thesis compares basis point sets."""

import itertools
import math
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.geometry.clouds import Normalisation, NormalisedClouds
from plugins.encoder.grids.cells import CellEncoder, Side, chosen_centres


class TDF(CellEncoder):
    """Truncated distances of the cells of a grid over [-1, 1]³ from the normalised cloud (thesis §6.5.1).

    Features are (1, side, side, side), where x changes slowest, in the clouds' dtype. They are unsigned distances as a
    share of the truncation: 0 at a point, 1 at the truncation and beyond.

    Args:
        input_shape: (points, columns) of the largest cloud; coordinates in the first three columns.
        side: number of cells along each edge.
        truncation: largest distance, in edges of a cell; larger distances are set to this value.
        normalise: "unit_ball", "robust" or "none" (`framework.geometry.clouds.normalise_clouds`).

    Raises:
        ConfigError: the input is not a cloud.
    """

    bibtex = "curless1996volumetric"
    by = "encoder tdf"

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        side: Side = 32,
        truncation: Annotated[float, Field(gt=0, le=4)] = 1.0,
        normalise: Normalisation = "unit_ball",
    ) -> None:
        super().__init__(input_shape, side=side, normalise=normalise)
        self.truncation = truncation

    def encode(self, clouds: Float[Tensor, "batch points columns"]) -> Float[Tensor, "batch cells"]:
        """Return the truncated distances of the cells."""
        return truncated_distance(clouds, self.side, self.truncation)


def truncated_distance(
    clouds: Float[Tensor, "batch points columns"], side: int, truncation: float
) -> Float[Tensor, "batch cells"]:
    """Return the truncated distance from the centre of each of the side³ cells of [-1, 1]³ to the nearest point.

    In the order of the cells, x changes slowest. Distances are shares of the truncation, 0 to 1. They are
    differentiable in the clouds. Only cells near a point are computed, so that cells beyond the truncation cost
    nothing.

    Args:
        clouds: normalised clouds; rows of NaN are padding.
        side: number of cells along each edge.
        truncation: largest distance, in edges of a cell.
    """
    real = ~clouds[..., 0].isnan()
    reach = math.floor(truncation + 1 / 2)
    # the centre of a cell that is n steps away along an axis is at least n - 1/2 edges away along it
    near = [max(abs(step) - 1 / 2, 0) ** 2 for step in range(-reach, reach + 1)]
    squares, numbers = [], []  # for each axis, those of each step from a point's own cell
    steps = torch.arange(-reach, reach + 1, dtype=clouds.dtype, device=clouds.device)[:, None, None]
    for axis, stride in enumerate((side * side, side, 1)):
        # in edges of a cell, from the cube's corner
        position = (clouds[..., axis].where(real, 0) + 1) / 2 * side
        cells = position.detach().floor().clamp(-side - 1, 2 * side + 1) + steps
        inside = real & (cells >= 0) & (cells < side)
        squares.append((position - (cells + 1 / 2)).square().where(inside, math.inf).unbind())
        numbers.append((cells.clamp(0, side - 1).long() * stride).unbind())
    square = clouds.new_full((clouds.shape[0], side**3), truncation**2)
    for x, y in itertools.product(range(2 * reach + 1), repeat=2):
        if near[x] + near[y] >= truncation**2:
            continue
        number_xy, square_xy = numbers[0][x] + numbers[1][y], squares[0][x] + squares[1][y]
        for z in range(2 * reach + 1):
            if near[x] + near[y] + near[z] >= truncation**2:
                continue
            number, candidate = number_xy + numbers[2][z], square_xy + squares[2][z]
            # an operation in place takes a trace longer, and is the same one in ONNX
            if candidate.requires_grad or torch.compiler.is_exporting():
                square = square.scatter_reduce(1, number, candidate, "amin")
            else:
                square.scatter_reduce_(1, number, candidate, "amin")
    root = square.where(square > 0, 1).sqrt().where(square > 0, 0)  # the root of 0 has no derivative
    return root / truncation


def decode(
    field: Float[Tensor, "batch cells"], side: int, normalised: NormalisedClouds
) -> Float[Tensor, "batch points 3"]:
    """Return the centres of the cells whose distance in `field` is below the truncation, that is, below 1.

    The centres are in the clouds' own units, padded with rows of NaN (`chosen_centres`).

    Args:
        field: truncated distances, as `truncated_distance` returns them.
        side: number of cells along each edge.
        normalised: the encoded clouds, whose centre and scale convert the centres to the clouds' units.
    """
    return chosen_centres(field < 1, field, side, normalised, "near a point")
