"""Errors of the point prediction of reals, in the unit of the target."""

from abc import abstractmethod
from typing import ClassVar, Literal, final

import torch
from jaxtyping import Float
from torch import Tensor

from framework.metric import Mean
from framework.prediction import Prediction
from framework.target import Target

FIRST = 6
"""Largest number of reals for which the error of each is reported too; of more reals only the mean is reported."""


class Errors(Mean):
    """Base class of errors: the mean of a power of each number's error, for all numbers together and for each.

    Raises:
        ConfigError: the target is not made of reals.
    """

    bibtex = ""
    key: ClassVar[str]

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("real", by=f"metric {self.key}")
        self.names = names(self.key, target)
        self.start(len(self.names))

    @abstractmethod
    def power(self, error: Float[Tensor, "batch number"]) -> Float[Tensor, "batch number"]:
        """Return the power of the error whose mean is taken."""

    @abstractmethod
    def result(self, mean: Tensor, error: Tensor) -> tuple[Tensor, Tensor]:
        """Return the reported number and its standard error, from the mean of the powers and its standard error."""

    def update(self, prediction: Prediction) -> None:
        # convert to float64 first, so that the difference is not rounded to float32
        each = self.power(prediction.point.double() - prediction.target.double())
        self.add_samples(torch.cat([each.mean(-1, keepdim=True), each[:, : len(self.names) - 1]], -1))

    def compute(self) -> dict[str, Tensor]:
        found: dict[str, Tensor] = {}
        for name, mean, error in zip(self.names, *self.mean_and_error(), strict=True):
            found[name], found[f"{name}_sem"] = self.result(mean, error)
        return found


@final
class MeanAbsoluteError(Errors):
    """Mean absolute error of the point prediction in the target's unit, with its standard error over samples.

    For several reals, `mae` is the mean over them and `mae_<name>` the error of one real.
    """

    key = "mae"
    columns: ClassVar[dict[str, str]] = {"mae": "MAE"}
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = {"mae": "lower"}

    def power(self, error: Float[Tensor, "batch number"]) -> Float[Tensor, "batch number"]:
        return error.abs()

    def result(self, mean: Tensor, error: Tensor) -> tuple[Tensor, Tensor]:
        return mean, error


@final
class RootMeanSquareError(Errors):
    """Root of the mean squared error of the point prediction in the target's unit, with its standard error.

    For several reals, `rmse` is the root of the mean over them and `rmse_<name>` the error of one real. The standard
    error is that of the mean square s², divided by 2 s (delta method).
    """

    key = "rmse"
    columns: ClassVar[dict[str, str]] = {"rmse": "RMSE"}
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = {"rmse": "lower"}

    def power(self, error: Float[Tensor, "batch number"]) -> Float[Tensor, "batch number"]:
        return error.square()

    def result(self, mean: Tensor, error: Tensor) -> tuple[Tensor, Tensor]:
        root = mean.sqrt()
        # if every error is 0, so is its standard error; do not divide by 0
        return root, torch.where(root == 0, error, error / (2 * root))


def names(metric: str, target: Target) -> list[str]:
    """Return the names of the results: of all numbers together, then of each where there are 2 to FIRST numbers."""
    several = target.names if 1 < len(target.names) <= FIRST else ()
    return [metric, *(f"{metric}_{name}" for name in several)]
