"""Shared functions of the encoders of clouds on a grid over [-1, 1]³: reading clouds, and the way back to points."""

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


def on_cells(
    clouds: Float[Tensor, "batch points columns"],
    normalise: Normalisation,
    by: str,
    numbers: Callable[[Tensor, int], Tensor],
    side: int,
) -> Float[Tensor, "batch 1 side side side"]:
    """Return the result of `numbers` for normalised clouds on a grid of side³ cells, x slowest, one number per cell.

    Raises:
        DataError: as `framework.geometry.clouds.sizes`; with "none", clouds that were plainly not normalised.
    """
    counts = sizes(clouds)
    local = normalise_clouds(clouds, normalise, counts).clouds
    if normalise == "none":
        require_normalised(local[..., :3], 1.0, counts, by=by)
    return numbers(local, side).reshape(-1, 1, side, side, side)


def centres_of(
    chosen: Bool[Tensor, "batch cells"], like: Tensor, side: int, normalised: NormalisedClouds, what: str
) -> Float[Tensor, "batch points 3"]:
    """Return the centres of the chosen cells in the clouds' own units (§6.4.1).

    The result is padded as clouds are, and has the dtype of `like`.

    Args:
        chosen: whether each cell is chosen, (batch, side³), x slowest.
        like: tensor whose dtype and device the centres get.
        side: number of cells along each edge.
        normalised: the encoded clouds; their centre and scale lead back to the clouds' units.
        what: adjective for a chosen cell in the message, such as "occupied".

    Raises:
        DataError: no cell of a cloud is chosen, since all its points are outside the cube.
    """
    empty = (~chosen).all(1).nonzero()
    if len(empty):
        raise DataError(
            f"No cell of cloud {int(empty[0])} is {what}; wanted one at least. All its points are outside of "
            "[-1, 1]³: choose normalise=unit_ball."
        )
    centres = cell_centres(side).to(like)
    return denormalise_clouds(pad([centres[cells] for cells in chosen]), normalised.centre, normalised.scale)
