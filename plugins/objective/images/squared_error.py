"""Mean squared difference between predicted and true images."""

from typing import Annotated

from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.data import Batch
from framework.model import Predictor, independent_penalty
from framework.objective import Objective
from plugins.objective.images.predicted import predicted_images


class SquaredError(Objective):
    """Mean squared difference between the sRGB values of predicted and true images, which determines the PSNR.

    The gradient of an absolute difference is the same for every error, and its optimum is a median. A squared
    difference gives more weight to large errors, such as a silhouette in the wrong place (Wang and Bovik 2009, §II).

    Args:
        weight: factor; an error d in [0, 1] costs weight · d², which is more than |d| if d > 1 / weight.
    """

    bibtex = "wang2009mean"

    def __init__(self, *, weight: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 5.0) -> None:
        super().__init__()
        self.weight = weight

    def forward(self, predictor: Predictor, batch: Batch) -> Float[Tensor, ""]:
        """Return the weighted penalty of a batch."""
        images, true = predicted_images(predictor, batch)
        mean = independent_penalty((images - true).square().mean((-3, -2, -1))).sum() / max(1, len(images))
        self.logged_terms = {"squared_error": mean.detach()}
        return self.weight * mean
