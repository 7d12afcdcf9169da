"""Squared distance of predicted and true images."""

from typing import Annotated

from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.data import Batch
from framework.model import Predictor, independent_penalty
from framework.objective import Objective
from plugins.objective.images.predicted import predicted_images


class SquaredError(Objective):
    """Mean squared distance of an image's numbers; the peak signal-to-noise ratio is a function of it.

    The absolute distance has the same gradient for every error, and its optimum is a median. The squared distance gives
    more weight to large errors, such as a silhouette in the wrong place (Wang and Bovik 2009, §II).

    Args:
        weight: factor. An error d of the range [0, 1] counts more by its square than by |d| if d > 1 / weight.
    """

    bibtex = """@article{wang2009mean,
  author  = {Wang, Zhou and Bovik, Alan C.},
  title   = {Mean Squared Error: Love It or Leave It? {A} New Look at Signal Fidelity Measures},
  journal = {IEEE Signal Processing Magazine},
  volume  = {26},
  number  = {1},
  pages   = {98--117},
  year    = {2009}
}"""

    def __init__(self, *, weight: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 5.0) -> None:
        super().__init__()
        self.weight = weight

    def forward(self, predictor: Predictor, batch: Batch) -> Float[Tensor, ""]:
        """Return the weighted penalty of a batch."""
        images, true = predicted_images(predictor, batch)
        mean = independent_penalty((images - true).square().mean((-3, -2, -1))).sum() / max(1, len(images))
        self.logged_terms = {"squared_error": mean.detach()}
        return self.weight * mean
