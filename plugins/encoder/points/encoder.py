"""An encoder whose features are points of the cloud, the same number for each cloud."""

from typing import Annotated

from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.encoder import Encoder
from framework.geometry.clouds import Normalisation, normalise_clouds, require_clouds, sizes
from plugins.encoder.points.subset import Choice, choose_points


class Points(Encoder):
    """A fixed number of points of each normalised cloud, with their attributes, for networks on point sets.

    Features are (points, columns), of the clouds' dtype.

    Args:
        input_shape: (points, columns) of the largest cloud; coordinates in the first three columns.
        points: number of points; smaller clouds repeat their points.
        choice: "random", or "farthest" from the points chosen before (`plugins.encoder.points.subset`).
        normalise: "unit_ball", "robust" or "none" (`framework.geometry.clouds.normalise_clouds`), applied to the whole
            cloud.
        seed: seed of "random"; the run's seed has no influence on it.

    Raises:
        ConfigError: the input is not a cloud.
    """

    fixed = True
    bibtex = "eldar1997farthest"

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        points: Annotated[int, Field(gt=0, le=10_000_000)] = 1024,
        choice: Choice = "random",
        normalise: Normalisation = "unit_ball",
        seed: Annotated[int, Field(ge=0, lt=2**32)] = 13,
    ) -> None:
        super().__init__()
        require_clouds(input_shape, by="encoder points")
        self.points = points
        self.choice: Choice = choice
        self.normalise: Normalisation = normalise
        self.seed = seed
        self.output_shape = (points, input_shape[1])

    def forward(self, inputs: Float[Tensor, "batch points columns"]) -> Float[Tensor, "batch *features"]:
        """Return the chosen points of the clouds."""
        counts = sizes(inputs)
        clouds = normalise_clouds(inputs, self.normalise, counts).clouds
        index = choose_points(clouds, counts, self.points, self.choice, self.seed)
        return clouds.gather(1, index[..., None].expand(-1, -1, clouds.shape[2]))
