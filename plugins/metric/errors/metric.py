"""Errors of the point prediction of real-valued targets, in the unit of the target."""

from abc import abstractmethod
from typing import ClassVar, final

import torch
from jaxtyping import Float
from torch import Tensor

from framework.metric import Directions, Mean, columns_by_number
from framework.prediction import Prediction
from framework.target import Target


class Errors(Mean):
    """Base class of metrics that are computed from the mean of |error| or error², such as MAE and RMSE.

    The error is that of the point prediction. Its mean is taken over all numbers of the target and, if there are few,
    also for each number.

    Raises:
        ConfigError: the target is not real-valued.
    """

    bibtex = ""
    key: ClassVar[str]

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("real", by=f"metric {self.key}")
        self.columns = columns_by_number(self.key, self.columns[self.key], target)  # pyright: ignore[reportAttributeAccessIssue]
        self.better = dict.fromkeys(self.columns, "lower")  # pyright: ignore[reportAttributeAccessIssue]
        self.names = [*self.columns]
        self.start(len(self.names))

    @abstractmethod
    def power(self, error: Float[Tensor, "batch number"]) -> Float[Tensor, "batch number"]:
        """Return the function of the error whose mean is taken, such as its square."""

    def result(self, mean: Tensor, error: Tensor) -> tuple[Tensor, Tensor]:
        """Return the reported number and its standard error: by default the mean of `power` itself.

        Args:
            mean: mean of `power` over samples.
            error: standard error of this mean.
        """
        return mean, error

    def update(self, prediction: Prediction) -> None:
        # convert to float64 first, so that the difference is not rounded to float32
        powers = self.power(prediction.point.double() - prediction.target.double())
        self.add_samples(torch.cat([powers.mean(-1, keepdim=True), powers[:, : len(self.names) - 1]], -1))

    def compute(self) -> dict[str, Tensor]:
        results: dict[str, Tensor] = {}
        for name, mean, error in zip(self.names, *self.mean_and_error(), strict=True):
            results[name], results[f"{name}_sem"] = self.result(mean, error)
        return results


@final
class MeanAbsoluteError(Errors):
    """Mean absolute error of the point prediction in the target's unit, with its standard error over samples.

    For a target of several numbers, `mae` is the mean over all numbers, and `mae_<name>` is the error of one number.
    """

    key = "mae"
    columns: ClassVar[dict[str, str]] = {"mae": "MAE"}
    better: ClassVar[Directions] = {"mae": "lower"}

    def power(self, error: Float[Tensor, "batch number"]) -> Float[Tensor, "batch number"]:
        return error.abs()


@final
class RootMeanSquareError(Errors):
    """Root of the mean squared error of the point prediction in the target's unit, with its standard error.

    For a target of several numbers, `rmse` is over all numbers, and `rmse_<name>` is the error of one number. The
    standard error is the standard error of the mean square, divided by twice the root (delta method).
    """

    key = "rmse"
    columns: ClassVar[dict[str, str]] = {"rmse": "RMSE"}
    better: ClassVar[Directions] = {"rmse": "lower"}

    def power(self, error: Float[Tensor, "batch number"]) -> Float[Tensor, "batch number"]:
        return error.square()

    def result(self, mean: Tensor, error: Tensor) -> tuple[Tensor, Tensor]:
        root = mean.sqrt()
        # if all errors are 0, the standard error is 0 too; do not divide by 0
        return root, torch.where(root == 0, error, error / (2 * root))
