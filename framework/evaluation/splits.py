"""Runs a predictor over a split: metrics, per group and in all, and what the prediction costs."""

import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch

from framework.data import Batch
from framework.density_head import Fitted
from framework.distributions.noise import Draw
from framework.errors import ConfigError
from framework.evaluation.cost import Cost, measure
from framework.metric import Metric
from framework.model import Predictor
from framework.prediction import Prediction, Split

BLOCK = 64
"""Samples that are evaluated at once. Draws are a function of (seed, sample) only where it is one number for all: a
density may draw for a whole batch at once. No gradient is kept: it takes less memory than training on as many."""


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
    """Every metric over every batch; noise is a function of (seed, batch, metric).

    So a second call gives the same bits, also with other metrics beside.

    Args:
        batches: of BLOCK samples, so that the numbers do not depend on the batch size of training.
        outliers: of another data set; seen by the metrics that read them, in every group.
    """
    predictor.eval().to(device)
    several = len(groups) > 1
    apart = {name: _fresh(metrics, device) for name in groups} if several else {}
    together = _fresh(metrics, device)
    for number, batch in enumerate(on_device(batches, device)):
        _update(together, predictor, batch, samples, Draw(seed, number))
        for index, name in enumerate(groups if several else ()):
            rows = (batch["group"] == index).nonzero().flatten()
            if len(rows):
                some = {key: value[rows] for key, value in batch.items()}
                _update(apart[name], predictor, some, samples, Draw(seed, number))
    everyone = [metric for group in (together, *apart.values()) for metric in group]
    for number, batch in enumerate(on_device(outliers, device)):
        _update(everyone, predictor, batch, samples, Draw(seed, number), "outliers")
    return Evaluation(numbers(together), {name: numbers(group) for name, group in apart.items()}, together)


def _fresh(metrics: Sequence[Metric], device: torch.device) -> list[Metric]:
    return [cast(Metric, metric.clone().to(device)) for metric in metrics]


def predicted(
    predictor: Predictor,
    batch: Batch,
    samples: int,
    draw: Draw,
    split: Split = "test",
    reads: Collection[str] = (),
) -> Prediction:
    """What is predicted for a batch, whatever mode asks: what is drawn for it is a function of `draw`."""
    with draw(split):
        density = predictor(batch["input"])
    return Prediction(density, batch, samples, split, draw, reads)


def _update(
    metrics: Sequence[Metric],
    predictor: Predictor,
    batch: Batch,
    samples: int,
    draw: Draw,
    split: Split = "test",
) -> None:
    readers = [metric for metric in metrics if split in metric.splits]
    reads = {channel for metric in readers for channel in metric.reads}
    prediction = predicted(predictor, batch, samples, draw, split, reads)
    for metric in readers:
        with draw(f"{split} {type(metric).__name__}"):
            metric.update(prediction)


def numbers(metrics: Sequence[Metric]) -> dict[str, float]:
    """What all of them compute.

    Raises:
        ConfigError: something is not one number, or two metrics call theirs the same.
    """
    found: dict[str, float] = {}
    owners: dict[str, Metric] = {}
    for metric in metrics:
        computed: dict[str, Any] = metric.compute()
        for name, value in computed.items():
            require_own(owners, name, metric)
            shape = tuple(getattr(value, "shape", ()))
            if math.prod(shape) != 1:
                raise ConfigError(
                    f"{type(metric).__name__}.compute gives {name!r} of shape {shape}: wanted one number. Give each "
                    "a name of its own."
                )
            found[name] = float(value)
    return found


def require_own(owners: dict[str, Metric], name: str, metric: Metric) -> None:
    """Refuse a name that another metric has already, whose number one of the two would hide.

    Args:
        owners: the metric of each name so far; `name` is added.

    Raises:
        ConfigError: says which two.
    """
    other = owners.setdefault(name, metric)
    if other is not metric:
        raise ConfigError(
            f"Two metrics call a number {name!r}: {type(other).__name__} and {type(metric).__name__}. Leave one out; "
            "mode=test with the other gives its number of the same model."
        )


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
