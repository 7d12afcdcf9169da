"""Runs a predictor over a split: metrics, per group and in all, and what the prediction costs."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import cast

import torch

from framework.data import Batch
from framework.density_head import Fitted
from framework.evaluation.cost import Cost, measure
from framework.metric import Metric
from framework.model import Predictor
from framework.prediction import Prediction, Split
from framework.training.batches import seed_step


@dataclass(frozen=True)
class Evaluation:
    """Numbers of one split: over everything, and per group where there are several."""

    total: dict[str, float]
    groups: dict[str, dict[str, float]]
    metrics: list[Metric]
    """Those over everything, as they stood at the end."""


def on_device(batches: Iterable[Batch], device: torch.device) -> Iterator[Batch]:
    """The same batches on `device`."""
    for batch in batches:
        yield {name: tensor.to(device, non_blocking=True) for name, tensor in batch.items()}


@torch.no_grad()
def evaluate(
    predictor: Predictor,
    batches: Iterable[Batch],
    metrics: Sequence[Metric],
    *,
    groups: Sequence[str],
    samples: int,
    seed: int,
    device: torch.device,
    outliers: Iterable[Batch] = (),
) -> Evaluation:
    """Every metric over every batch; noise is a function of (seed, batch), so a second call gives the same bits.

    Args:
        outliers: of another data set; seen by the metrics that read them, in every group.
    """
    predictor.eval().to(device)
    several = len(groups) > 1
    apart = {name: _fresh(metrics, device) for name in groups} if several else {}
    together = _fresh(metrics, device)
    for number, batch in enumerate(on_device(batches, device)):
        seed_step(seed, number, "test")
        _update(together, predictor, batch, samples)
        for index, name in enumerate(groups if several else ()):
            rows = (batch["group"] == index).nonzero().flatten()
            if len(rows):
                seed_step(seed, number, "test")
                some = {key: value[rows] for key, value in batch.items()}
                _update(apart[name], predictor, some, samples)
    everyone = [metric for group in (together, *apart.values()) for metric in group]
    for number, batch in enumerate(on_device(outliers, device)):
        seed_step(seed, number, "outliers")
        _update(everyone, predictor, batch, samples, "outliers")
    return Evaluation(_numbers(together), {name: _numbers(group) for name, group in apart.items()}, together)


def _fresh(metrics: Sequence[Metric], device: torch.device) -> list[Metric]:
    return [cast(Metric, metric.clone().to(device)) for metric in metrics]


def _update(
    metrics: Sequence[Metric], predictor: Predictor, batch: Batch, samples: int, split: Split = "test"
) -> None:
    reading = [metric for metric in metrics if split in metric.splits]
    prediction = Prediction(predictor(batch["input"]), batch, samples, split)
    for metric in reading:
        metric.update(prediction)


def _numbers(metrics: Sequence[Metric]) -> dict[str, float]:
    found: dict[str, float] = {}
    for metric in metrics:
        found |= {name: float(value) for name, value in metric.compute().items()}
    return found


@torch.no_grad()
def cost(predictor: Predictor, batch: Batch, *, samples: int, device: torch.device) -> Cost:
    """What one prediction costs: the density and the point prediction drawn from it."""
    predictor.eval().to(device)

    def predict(inputs: torch.Tensor) -> torch.Tensor:
        return Prediction(predictor(inputs), {}, samples).point

    # what a head fitted at once holds is no weights
    fitted = any(isinstance(part, Fitted) for part in predictor.modules())
    parameters = None if fitted else sum(parameter.numel() for parameter in predictor.parameters())
    return measure(predict, batch["input"].to(device), parameters=parameters)
