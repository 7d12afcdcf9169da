"""Errors of the point prediction of reals, in their own unit."""

from abc import abstractmethod
from typing import ClassVar, Literal, final

import torch
from jaxtyping import Float
from torch import Tensor

from framework.metric import Mean
from framework.prediction import Prediction
from framework.target import Target

FIRST = 6
"""Of more numbers than this only their mean is reported."""


class Errors(Mean):
    """What the errors share: the mean of a power of each number's error, reported together and for each number.

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
        """What the mean is taken of."""

    @abstractmethod
    def result(self, mean: Tensor, error: Tensor) -> tuple[Tensor, Tensor]:
        """The number to report and its standard error, from the mean's."""

    def update(self, prediction: Prediction) -> None:
        # in double precision before the difference rounds
        each = self.power(prediction.point.double() - prediction.target.double())
        self.take_in(torch.cat([each.mean(-1, keepdim=True), each[:, : len(self.names) - 1]], -1))

    def compute(self) -> dict[str, Tensor]:
        found: dict[str, Tensor] = {}
        for name, mean, error in zip(self.names, *self.mean_and_error(), strict=True):
            found[name], found[f"{name}_sem"] = self.result(mean, error)
        return found


@final
class MeanAbsoluteError(Errors):
    """Mean absolute error of the point prediction in the target's unit, with its standard error over samples.

    Of several reals `mae` is the mean over them, `mae_<name>` that of one.
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

    Of several reals `rmse` is the root of the mean over them, `rmse_<name>` that of one. The standard error is that of
    the mean square s² divided by 2 s (delta method).
    """

    key = "rmse"
    columns: ClassVar[dict[str, str]] = {"rmse": "RMSE"}
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = {"rmse": "lower"}

    def power(self, error: Float[Tensor, "batch number"]) -> Float[Tensor, "batch number"]:
        return error.square()

    def result(self, mean: Tensor, error: Tensor) -> tuple[Tensor, Tensor]:
        root = mean.sqrt()
        # without an error there is none to be uncertain of
        return root, torch.where(root == 0, error, error / (2 * root))


def names(metric: str, target: Target) -> list[str]:
    """What the results are called: of all numbers together, then of each where there are several, but not very many."""
    several = target.names if 1 < len(target.names) <= FIRST else ()
    return [metric, *(f"{metric}_{name}" for name in several)]
