"""Errors of the point prediction of reals, in their own unit."""

from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from framework.metric import Mean
from framework.prediction import Prediction
from framework.target import Target

FIRST = 6
"""Of more numbers than this only their mean is reported."""


class MeanAbsoluteError(Mean):
    """Mean absolute error of the point prediction in the target's unit, with its standard error over samples.

    Of several reals `mae` is the mean over them, `mae_<name>` that of one.

    Raises:
        ConfigError: the target is not made of reals.
    """

    bibtex = ""
    columns: ClassVar[dict[str, str]] = {"mae": "MAE"}
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = {"mae": "lower"}

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("real", by="metric mae")
        self.names = names("mae", target)
        self.start(len(self.names))

    def update(self, prediction: Prediction) -> None:
        self.take_in(with_mean(errors(prediction).abs(), len(self.names)))

    def compute(self) -> dict[str, Tensor]:
        mean, error = self.mean_and_error()
        found: dict[str, Tensor] = {}
        for index, name in enumerate(self.names):
            found |= {name: mean[index], f"{name}_sem": error[index]}
        return found


class RootMeanSquareError(Mean):
    """Root of the mean squared error of the point prediction in the target's unit, with its standard error.

    Of several reals `rmse` is the root of the mean over them, `rmse_<name>` that of one. The standard error is that of
    the mean square s² divided by 2 s (delta method).

    Raises:
        ConfigError: the target is not made of reals.
    """

    bibtex = ""
    columns: ClassVar[dict[str, str]] = {"rmse": "RMSE"}
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = {"rmse": "lower"}

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("real", by="metric rmse")
        self.names = names("rmse", target)
        self.start(len(self.names))

    def update(self, prediction: Prediction) -> None:
        self.take_in(with_mean(errors(prediction).square(), len(self.names)))

    def compute(self) -> dict[str, Tensor]:
        square, error = self.mean_and_error()
        found: dict[str, Tensor] = {}
        for index, name in enumerate(self.names):
            root = square[index].sqrt()
            # without an error there is none to be uncertain of
            spread = torch.where(root == 0, error[index], error[index] / (2 * root))
            found |= {name: root, f"{name}_sem": spread}
        return found


def names(metric: str, target: Target) -> list[str]:
    """What the results are called: of all numbers together, then of each where there are several, but not very many."""
    several = target.names if 1 < len(target.names) <= FIRST else ()
    return [metric, *(f"{metric}_{name}" for name in several)]


def errors(prediction: Prediction) -> Float[Tensor, "batch number"]:
    """Point prediction minus target, in double precision before the difference."""
    return prediction.point.double() - prediction.target.double()


def with_mean(each: Float[Tensor, "batch number"], count: int) -> Float[Tensor, "batch count"]:
    """The mean over the numbers, then as many of them as are reported."""
    return torch.cat([each.mean(-1, keepdim=True), each[:, : count - 1]], -1)
