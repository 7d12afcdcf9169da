"""Plugins of each registry that work on the CPU and fail on a GPU, because they mix devices."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.data import Batch
from framework.model import Predictor
from framework.prediction import Prediction
from framework.target import Target
from plugins.density_head.gaussian.density import Gaussian
from plugins.density_head.gaussian.head import GaussianHead
from tests.planted_encoders import IMAGE, VECTOR, Conv, Dense, Layered
from tests.planted_heads import CLASSES, HEIGHT, ONE, PLACE, Changed, Fault
from tests.planted_metrics import Hit, Kept, Turned, Within
from tests.planted_objectives import Confidence
from tests.planted_wrappers import Tempered, Weighted
from tests.right_heads import LaplaceHead

NAME = "on the device of its inputs"
WEIGHTS = torch.tensor([1.0, 2.0, 0.5])


class _Table(GaussianHead):
    """A head with a table in a plain attribute, which `Module.to` does not move."""

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        self.table = torch.full((len(target.names),), 0.5)

    def forward(self, raw: Tensor) -> Distribution:
        density = super().forward(raw)
        assert isinstance(density, Gaussian)
        return Gaussian(density.location, density.scale + self.table)


class _Calibrated(LaplaceHead):
    """A head that sorts residuals by NumPy in `calibrate`."""

    def calibrate(self, raw: Tensor, target: Tensor) -> None:
        residual = self(raw).mode - target
        np.argsort(residual.flatten().numpy())


def _lost(head: Any, raw: Tensor, target: Tensor) -> Tensor:
    return (-head(raw).log_prob(target)[..., None] * torch.ones(2)).mean(-1)


def _drawn(density: Any, shape: torch.Size) -> Tensor:
    noise = torch.randn((*shape, *density.mode.shape))
    return density.mode + noise * density.stddev


def _weighted(density: Any, value: Tensor) -> Tensor:
    return density.log_prob(value) + torch.zeros(value.shape[:-1]).expand(value.shape[:-1])


def _stacked(density: Any) -> Tensor:
    return torch.stack([density.entropy()[0], *[torch.zeros(())] * (len(density.mode) - 1)])


HEADS = (
    Fault("a table in an attribute", PLACE, {}, NAME, head=_Table),
    Fault("NumPy in calibrate", HEIGHT, {}, NAME, head=_Calibrated),
    Fault("noise of the CPU", HEIGHT, {"sample": _drawn}, NAME),
    Fault("zeros of the CPU are added", PLACE, {"log_prob": _weighted}, NAME),
    Fault("zeros of the CPU are stacked", HEIGHT, {"entropy": _stacked}, NAME),
    Fault("weights made for the loss", HEIGHT, {"loss": _lost}, NAME),
)


class _Wide(Dense):
    def forward(self, inputs: Tensor) -> Tensor:
        return super().forward(inputs) + torch.linspace(0, 1, 5)


class _Positions(Conv):
    """An encoder with the coordinate of each row of pixels in a plain attribute."""

    def __init__(self, input_shape: tuple[int, ...]) -> None:
        super().__init__(input_shape)
        self.rows = torch.arange(input_shape[1]).float()[:, None] / input_shape[1]

    def pixels(self, inputs: Tensor) -> Tensor:
        return super().pixels(inputs) + self.rows


class _Joined(Dense):
    def hidden(self, inputs: Tensor) -> Tensor:
        whole = torch.cat([inputs, torch.ones(len(inputs), 1)], -1)
        return super().hidden(whole[:, :-1])


class _Noisy(Layered):
    """An encoder that adds noise from the CPU in training."""

    def hidden(self, inputs: Tensor) -> Tensor:
        return super().hidden(inputs + torch.randn(inputs.shape) if self.training else inputs)


class _Array(Dense):
    def forward(self, inputs: Tensor) -> Tensor:
        return super().forward(torch.as_tensor(np.tanh(inputs.detach().numpy())))


ENCODERS: Mapping[str, tuple[Callable[..., Any], tuple[int, ...]]] = {
    "numbers made in forward": (_Wide, VECTOR),
    "positions in an attribute": (_Positions, IMAGE),
    "a column of ones": (_Joined, VECTOR),
    "noise in training": (_Noisy, VECTOR),
    "NumPy in forward": (_Array, VECTOR),
}


class _TemperatureInAnAttribute(Tempered):
    def fit(self, seen: list[Batch]) -> None:
        self.known = torch.tensor([1.5], dtype=torch.float64)

    def forward(self, inputs: Tensor) -> Distribution:
        density = super().forward(inputs)
        known = getattr(self, "known", None)
        return density if known is None else Changed(density, {"entropy": lambda d: d.entropy() * known})


class _WeightsMadeInForward(Weighted):
    def forward(self, inputs: Tensor) -> Distribution:
        density: Any = super().forward(inputs)
        return Changed(
            density, {"log_prob": lambda d, v: torch.stack([d.log_prob(v), torch.zeros(len(inputs))])[0]}
        )


class _Order(Tempered):
    """A wrapper that writes validation scores into a tensor on the CPU."""

    def fit(self, seen: list[Batch]) -> None:
        scores = self.log_probs(seen, torch.ones(()).double())
        kept = torch.zeros(len(scores), dtype=scores.dtype)
        kept[scores.argsort()] = scores


class _Constant(Tempered):
    """A wrapper whose loss multiplies by a tensor that is a constant of this file."""

    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        return (super().loss(inputs, target)[:, None] * WEIGHTS).mean(-1)


WRAPPERS: Mapping[str, tuple[Callable[..., Any], Target]] = {
    "a temperature in an attribute": (_TemperatureInAnAttribute, HEIGHT),
    "zeros stacked in log_prob": (_WeightsMadeInForward, CLASSES),
    "an array of the CPU in calibrate": (_Order, HEIGHT),
    "a constant of its module": (_Constant, ONE),
}


class _ByPlace(Confidence):
    def each(self, predictor: Predictor, batch: Batch) -> Tensor:
        found = super().each(predictor, batch)
        return found * torch.ones(len(found)).reshape(-1, *(1,) * (found.dim() - 1))


class _Reference(Confidence):
    """An objective that compares targets with a tensor on the CPU."""

    def forward(self, predictor: Predictor, batch: Batch) -> Tensor:
        kept = torch.zeros(batch["target"].shape, dtype=batch["target"].dtype)
        away = (batch["target"] - kept).double().square().mean()
        return super().forward(predictor, batch) + 0 * away


class _Masked(Confidence):
    def each(self, predictor: Predictor, batch: Batch) -> Tensor:
        found = super().each(predictor, batch)
        return found.masked_fill(torch.zeros(found.shape, dtype=torch.bool), 0.0)


OBJECTIVES: Mapping[str, tuple[Callable[..., Any], Target]] = {
    "weights of samples": (_ByPlace, CLASSES),
    "kept targets": (_Reference, PLACE),
    "a mask of the CPU": (_Masked, ONE),
}


class _Sums(Kept):
    """A metric that stacks its sums with zeros on the CPU."""

    def compute(self) -> dict[str, Tensor]:
        seen = self.all()
        numbers = torch.stack([seen.mean(), *[torch.zeros((), dtype=torch.float64)] * 2])
        return {"error": numbers[0], "error_sem": self.spread(seen)}


class _CountsInAnAttribute(Within):
    def __init__(self) -> None:
        super().__init__()
        self.edges = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)

    def each(self, prediction: Prediction) -> Tensor:
        error = Kept.each(self, prediction)
        return (torch.bucketize(error, self.edges) == 0).double()


class _OneHot(Hit):
    def update(self, prediction: Prediction) -> None:
        guess = prediction.class_probabilities.argmax(-1)
        hits = torch.zeros(len(guess), 3)
        hits[torch.arange(len(guess)), guess] = 1.0
        super().update(prediction)


class _Medians(Turned):
    def compute(self) -> dict[str, Tensor]:
        np.median(np.asarray(self.all()))
        return super().compute()


METRICS: Mapping[str, tuple[Callable[[], Any], Target]] = {
    "sums stacked with zeros": (_Sums, PLACE),
    "edges in an attribute": (_CountsInAnAttribute, HEIGHT),
    "a table of the CPU": (_OneHot, CLASSES),
    "NumPy in compute": (_Medians, ONE),
}
