"""Mean over samples of the largest error of each sample."""

from typing import ClassVar

from torch import Tensor

from framework.metric import Directions, Mean
from framework.prediction import Prediction
from framework.target import Target


class Example(Mean):
    """Mean over samples of the largest absolute error among a sample's numbers, in the unit of the target.

    The metric evaluates the point prediction. It also returns the standard error of this mean.

    Raises:
        ConfigError: the target is not real-valued.
    """

    bibtex = ""
    columns: ClassVar[dict[str, str]] = {"example": "largest error"}
    better: ClassVar[Directions] = {"example": "lower"}

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("real", by="metric example")
        self.start()

    def update(self, prediction: Prediction) -> None:
        """Add the predictions of a batch."""
        # convert to float64 first, so that the difference is not rounded to float32
        error = prediction.point.double() - prediction.target.double()
        self.add_samples(error.abs().amax(-1))

    def compute(self) -> dict[str, Tensor]:
        """Return the mean and its standard error."""
        mean, error = self.mean_and_error()
        return {"example": mean, "example_sem": error}
