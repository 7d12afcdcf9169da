"""Shared functions of the encoders that represent clouds on a grid over [-1, 1]³: encoding and decoding."""

from collections.abc import Callable

from jaxtyping import Bool, Float
from torch import Tensor

from framework.errors import DataError
from framework.geometry.clouds import (
    Normalisation,
    NormalisedClouds,
    cell_centres,
    denormalise_clouds,
    normalise_clouds,
    pad,
    require_normalised,
    sizes,
)


def encode_on_cells(
    clouds: Float[Tensor, "batch points columns"],
    normalise: Normalisation,
    by: str,
    numbers: Callable[[Tensor, int], Tensor],
    side: int,
) -> Float[Tensor, "batch 1 side side side"]:
    """Return one number per cell of a grid of side³ cells over the normalised clouds, where x changes slowest.

    Args:
        clouds: (batch, points, columns).
        normalise: as in `framework.geometry.clouds.normalise_clouds`.
        by: name of the encoder, for messages.
        numbers: function of the normalised clouds and of `side` that returns the numbers, (batch, side³).
        side: number of cells along each edge.

    Raises:
        DataError: as `framework.geometry.clouds.sizes`; or `normalise` is "none" and the clouds are clearly not
            normalised.
    """
    counts = sizes(clouds)
    local = normalise_clouds(clouds, normalise, counts).clouds
    if normalise == "none":
        require_normalised(local[..., :3], 1.0, counts, by=by)
    return numbers(local, side).reshape(-1, 1, side, side, side)


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
