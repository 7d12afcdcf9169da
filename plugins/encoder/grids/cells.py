"""Base class of the encoders on a grid over [-1, 1]³, and the decoding of cells to points."""

from abc import abstractmethod
from typing import Annotated, ClassVar

from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from framework.encoder import Encoder
from framework.errors import DataError
from framework.geometry.clouds import (
    Normalisation,
    NormalisedClouds,
    cell_centres,
    denormalise_clouds,
    normalise_clouds,
    pad,
    require_clouds,
    require_normalised,
    sizes,
)

Side = Annotated[int, Field(gt=0, le=512)]


class CellEncoder(Encoder):
    """Base class of encoders that return one number per cell of a grid of side³ cells over the normalised clouds.

    Args:
        input_shape: (points, columns) of the largest cloud.
        side: number of cells along each edge.
        normalise: "unit_ball", "robust" or "none" (`framework.geometry.clouds.normalise_clouds`).

    Attributes:
        by: name of the encoder, for messages.

    Raises:
        ConfigError: the input is not a cloud.
    """

    fixed = True
    by: ClassVar[str]

    def __init__(
        self, input_shape: tuple[int, ...], *, side: Side = 32, normalise: Normalisation = "unit_ball"
    ) -> None:
        super().__init__()
        require_clouds(input_shape, by=self.by)
        self.side = side
        self.normalise: Normalisation = normalise
        self.output_shape = (1, side, side, side)

    @abstractmethod
    def encode(self, clouds: Float[Tensor, "batch points columns"]) -> Float[Tensor, "batch cells"]:
        """Return one number for each cell, for normalised clouds; x changes slowest in the order of the cells."""

    def forward(
        self, inputs: Float[Tensor, "batch points columns"]
    ) -> Float[Tensor, "batch 1 side side side"]:
        """Return the numbers of the cells.

        Raises:
            DataError: a cloud has no points, or a number of a point is not finite; or `normalise` is "none" and the
                clouds are clearly not normalised.
        """
        counts = sizes(inputs)
        local = normalise_clouds(inputs, self.normalise, counts).clouds
        if self.normalise == "none":
            require_normalised(local[..., :3], 1.0, counts, by=self.by)
        return self.encode(local).reshape(-1, *self.output_shape)


def chosen_centres(
    chosen: Bool[Tensor, "batch cells"], like: Tensor, side: int, normalised: NormalisedClouds, adjective: str
) -> Float[Tensor, "batch points 3"]:
    """Return the centres of the chosen cells in the clouds' own units (§6.4.1).

    The result is padded with rows of NaN.

    Args:
        chosen: whether each cell is chosen, (batch, side³), where x changes slowest.
        like: tensor whose dtype and device the result has.
        side: number of cells along each edge.
        normalised: the encoded clouds, whose centre and scale convert the centres to the clouds' units.
        adjective: adjective for a chosen cell in the message, such as "occupied".

    Raises:
        DataError: no cell of a cloud is chosen, because all points of the cloud are outside the cube.
    """
    empty = (~chosen).all(1).nonzero()
    if len(empty):
        raise DataError(
            f"No cell of cloud {int(empty[0])} is {adjective}, but at least one is required: all points of this cloud "
            "are outside [-1, 1]³. Set normalise=unit_ball."
        )
    centres = cell_centres(side).to(like)
    return denormalise_clouds(pad([centres[cells] for cells in chosen]), normalised.centre, normalised.scale)
