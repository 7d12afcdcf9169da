"""Occupancy grids, the rival of point-set encodings that fills space with flags."""

from typing import Annotated

from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.encoder import Encoder
from framework.geometry.clouds import Normalisation, normalised, require_clouds, require_normalised, sizes
from plugins.encoder.grids.occupancy.grid import occupancy


class Occupancy(Encoder):
    """Which cells of a grid over [-1, 1]³ hold a point of the normalised cloud (thesis §6.4.1, §6.5.1).

    Args:
        input_shape: (points, columns) of the largest cloud; coordinates in the first three columns.
        side: cells along each edge.
        normalise: as `framework.geometry.clouds.normalised`. With "robust" far outliers lie in no cell.

    Features are (1, side, side, side), x slowest, 0 or 1, of the clouds' dtype; no gradient leads back.

    Raises:
        ConfigError: an input that is no cloud.
    """

    fixed = True
    bibtex = """@inproceedings{maturana2015voxnet,
  title = {VoxNet: A 3D Convolutional Neural Network for Real-Time Object Recognition},
  author = {Maturana, Daniel and Scherer, Sebastian},
  booktitle = {IEEE/RSJ International Conference on Intelligent Robots and Systems (IROS)},
  year = {2015}
}"""

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        side: Annotated[int, Field(gt=0, le=512)] = 32,
        normalise: Normalisation = "unit_ball",
    ) -> None:
        super().__init__()
        require_clouds(input_shape, by="encoder occupancy")
        self.side = side
        self.normalise: Normalisation = normalise
        self.output_shape = (1, side, side, side)

    def forward(self, inputs: Float[Tensor, "batch points columns"]) -> Float[Tensor, "batch *features"]:
        counts = sizes(inputs)
        clouds = normalised(inputs.detach(), self.normalise, counts).clouds
        if self.normalise == "none":
            require_normalised(clouds[..., :3], 1.0, counts, by="encoder occupancy")
        return occupancy(clouds, self.side).reshape(-1, *self.output_shape)
