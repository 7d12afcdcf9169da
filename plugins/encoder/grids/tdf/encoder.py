"""Truncated distance fields, the rival of point-set encodings that fills space with local distances."""

from typing import Annotated

from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.encoder import Encoder
from framework.geometry.clouds import Normalisation, normalised, require_clouds, require_normalised, sizes
from plugins.encoder.grids.tdf.field import truncated_distance


class TDF(Encoder):
    """How far the cells of a grid over [-1, 1]³ are from the normalised cloud, cut off within a cell (thesis §6.5.1).

    Args:
        input_shape: (points, columns) of the largest cloud; coordinates in the first three columns.
        side: cells along each edge.
        truncation: distance that counts as far, in edges of a cell.
        normalise: as `framework.geometry.clouds.normalised`.

    Features are (1, side, side, side), x slowest, unsigned distances as a share of the truncation: 0 at a point, 1 at
    the truncation and beyond. Of the clouds' dtype.

    Raises:
        ConfigError: an input that is no cloud.
    """

    fixed = True
    bibtex = """@inproceedings{curless1996volumetric,
  title = {A Volumetric Method for Building Complex Models from Range Images},
  author = {Curless, Brian and Levoy, Marc},
  booktitle = {Proceedings of SIGGRAPH},
  year = {1996}
}"""

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        side: Annotated[int, Field(gt=0, le=512)] = 32,
        truncation: Annotated[float, Field(gt=0, le=4)] = 1.0,
        normalise: Normalisation = "unit_ball",
    ) -> None:
        super().__init__()
        require_clouds(input_shape, by="encoder tdf")
        self.side = side
        self.truncation = truncation
        self.normalise: Normalisation = normalise
        self.output_shape = (1, side, side, side)

    def forward(self, inputs: Float[Tensor, "batch points columns"]) -> Float[Tensor, "batch *features"]:
        counts = sizes(inputs)
        clouds = normalised(inputs, self.normalise, counts).clouds
        if self.normalise == "none":
            require_normalised(clouds[..., :3], 1.0, counts, by="encoder tdf")
        return truncated_distance(clouds, self.side, self.truncation).reshape(-1, *self.output_shape)
