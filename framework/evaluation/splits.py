"""Evaluation of a predictor on a split: metrics in total and per group, and the cost of a prediction."""

import logging
import math
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import torch

from framework.data import Batch
from framework.density_head import Fitted
from framework.distributions.noise import Draw
from framework.errors import ConfigError
from framework.evaluation.cost import REPEATS, Cost, measure
from framework.model import Predictor
from framework.prediction import Prediction, Split

if TYPE_CHECKING:  # a metric imports torchmetrics, which predictions do not need
    from framework.metric import Metric

_log = logging.getLogger(__name__)
BLOCK = 64
"""Number of samples that are evaluated at once.

The number must be the same everywhere: a density may draw for a whole batch at once, so the random values of a sample
would otherwise depend on the size of its batch. Evaluation keeps no gradients, so it takes less memory than training
with batches of this size.
"""


@dataclass(frozen=True)
class Evaluation:
    """Values of the metrics on one split: in total over all samples, and per group if there are several groups."""

    total: dict[str, float]
    groups: dict[str, dict[str, float]]
    metrics: "list[Metric]"
    """Metric objects after all samples, from which figures can be drawn."""


def on_device(batches: Iterable[Batch], device: torch.device) -> Iterator[Batch]:
    """Yield the batches on `device`."""
    for batch in batches:
        yield {name: tensor.to(device, non_blocking=True) for name, tensor in batch.items()}


@torch.no_grad()
def evaluate(
    predictor: Predictor,
    batches: Iterable[Batch],
    metrics: "Sequence[Metric]",
    *,
    groups: Sequence[str],
    samples: int,
    seed: int,
    device: torch.device,
    outliers: Iterable[Batch] = (),
) -> Evaluation:
    """Return the value of every metric over all batches, in total and per group.

    Random numbers are a function of (seed, batch, metric), so a second call returns the same bits, even with more
    metrics.

    Args:
        predictor: the trained predictor; it is moved to `device`.
        batches: batches of BLOCK samples, so that the numbers do not depend on the batch size of training.
        metrics: metrics to compute; they are copied.
        groups: names of the groups of samples; the field "group" of a batch holds indices of these names.
        samples: number of samples for a point prediction that has no closed form.
        seed: seed of the random numbers.
        device: device to predict on.
        outliers: batches of outliers; the metrics that read outliers get all of them, in total and in every group.
    """
    predictor.eval().to(device)
    several = len(groups) > 1
    by_group = {name: fresh(metrics, device) for name in groups} if several else {}
    overall = fresh(metrics, device)
    for number, batch in enumerate(on_device(batches, device)):
        _update(overall, predictor, batch, samples, Draw(seed, number))
        for index, name in enumerate(groups if several else ()):
            rows = (batch["group"] == index).nonzero().flatten()
            if len(rows):
                group_batch = {key: value[rows] for key, value in batch.items()}
                _update(by_group[name], predictor, group_batch, samples, Draw(seed, number))
    all_metrics = [metric for group in (overall, *by_group.values()) for metric in group]
    for number, batch in enumerate(on_device(outliers, device)):
        _update(all_metrics, predictor, batch, samples, Draw(seed, number), "outliers")
    total = numbers(overall)
    for remark in (remark for metric in overall for remark in metric.remarks()):
        _log.warning(remark)
    return Evaluation(total, {name: numbers(group) for name, group in by_group.items()}, overall)


def fresh(metrics: "Sequence[Metric]", device: torch.device) -> "list[Metric]":
    """Return copies of the metrics on a device."""
    return [cast("Metric", metric.clone().to(device)) for metric in metrics]


def predict(
    predictor: Predictor,
    batch: Batch,
    samples: int,
    draw: Draw,
    split: Split = "test",
    reads: Collection[str] = (),
) -> Prediction:
    """Return the prediction for a batch; it is the same in every mode, because all random numbers come from `draw`.

    Args:
        predictor: the trained predictor.
        batch: the batch, on the predictor's device.
        samples: number of samples for a point prediction that has no closed form.
        draw: source of the random numbers.
        split: "test" for a batch of the test split, "outliers" for a batch of outliers.
        reads: channels of images that will be requested, so that they are drawn together.
    """
    with draw(split):
        density = predictor(batch["input"])
    return Prediction(density, batch, samples, split, draw, reads)


def _update(
    metrics: "Sequence[Metric]",
    predictor: Predictor,
    batch: Batch,
    samples: int,
    draw: Draw,
    split: Split = "test",
) -> None:
    """Update the metrics that read `split` with the prediction for a batch."""
    readers = [metric for metric in metrics if split in metric.splits]
    reads = {channel for metric in readers for channel in metric.reads}
    prediction = predict(predictor, batch, samples, draw, split, reads)
    for metric in readers:
        with draw(f"{split} {type(metric).__name__}"):
            metric.update(prediction)


def numbers(metrics: "Sequence[Metric]") -> dict[str, float]:
    """Return the numbers that all metrics compute, by name.

    Raises:
        ConfigError: a metric returns no dictionary, or none of the numbers of its columns; a value is not a single
            number; or two metrics use the same name.
    """
    values: dict[str, float] = {}
    owners: dict[str, Metric] = {}
    for metric in metrics:
        computed: dict[str, Any] = metric.compute()
        if not isinstance(computed, Mapping) or (metric.columns and not {*metric.columns} & {*computed}):
            result = ", ".join(computed) if isinstance(computed, Mapping) else f"a {type(computed).__name__}"
            raise ConfigError(
                f"{type(metric).__name__}.compute returns {result}, but a dictionary with the names in `columns` is "
                f"required: {', '.join(metric.columns)}. Return each number under its name, or correct `columns`."
            )
        for name, value in computed.items():
            require_unique_name(owners, name, metric)
            shape = tuple(getattr(value, "shape", ()))
            if math.prod(shape) != 1:
                raise ConfigError(
                    f"{type(metric).__name__}.compute returns {name!r} with shape {shape}, but each name must have "
                    "one number. Return every number under a name of its own."
                )
            values[name] = float(value)
    return values


def require_unique_name(owners: "dict[str, Metric]", name: str, metric: "Metric") -> None:
    """Raise an error if another metric already uses a name, because one of the two numbers would be lost.

    Args:
        owners: metrics so far, by the names that they use; `name` is added.
        name: the name to check.
        metric: the metric that uses it.

    Raises:
        ConfigError: the name is in use; the message names both metrics.
    """
    other = owners.setdefault(name, metric)
    if other is not metric:
        raise ConfigError(
            f"Two metrics use the name {name!r}: {type(other).__name__} and {type(metric).__name__}. Leave one of "
            "them out, and compute it with mode=test for the same model."
        )


@contextmanager
def silence() -> Iterator[None]:
    """Suppress warnings, and log messages below the level ERROR, during the block."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


@torch.no_grad()
def cost(
    predictor: Predictor, batch: Batch, *, samples: int, device: torch.device, repeats: int = REPEATS
) -> Cost:
    """Return the cost of predicting the density and the point prediction for a batch.

    Args:
        predictor: the trained predictor; it is moved to `device`.
        batch: the batch.
        samples: number of samples for a point prediction that has no closed form.
        device: device to predict on.
        repeats: number of timed calls with the batch, and with one sample.
    """
    predictor.eval().to(device)

    def predict(inputs: torch.Tensor) -> torch.Tensor:
        return Prediction(predictor(inputs), {}, samples).point

    # A head that is fitted at once has no weights to count.
    fitted = any(isinstance(part, Fitted) for part in predictor.modules())
    parameters = None if fitted else sum(parameter.numel() for parameter in predictor.parameters())
    return measure(predict, batch["input"].to(device), parameters=parameters, repeats=repeats)
