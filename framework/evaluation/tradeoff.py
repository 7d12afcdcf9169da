"""Any metric against run time as a knob is turned: how much an ensemble's next member or a further pass buys."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from framework.data import Batch
from framework.density_head import DensityHead
from framework.errors import ConfigError, did_you_mean
from framework.evaluation.cost import device_name
from framework.evaluation.splits import evaluate
from framework.evaluation.work_precision import front, run_times
from framework.metric import Metric
from framework.model import Predictor
from framework.reports import table
from framework.uncertainty import Uncertainty


@dataclass(frozen=True)
class Turn:
    """What one value of a knob gives.

    Attributes:
        value: where the knob stood.
        metrics: by name, averaged over repeats.
        spreads: their standard deviations over the repeats; NaN for one.
        milliseconds: median wall time per sample, from input to log-likelihood.
    """

    value: int
    metrics: Mapping[str, float]
    spreads: Mapping[str, float]
    milliseconds: float


def owners(predictor: Predictor, knob: str) -> list[Uncertainty | DensityHead]:
    """The parts that have a knob of that name: wrappers, or else heads. None of the name "", which turns nothing.

    Raises:
        ConfigError: none has; says which knobs there are.
    """
    if not knob:
        return []
    parts = [part for part in predictor.modules() if isinstance(part, Uncertainty | DensityHead)]
    found = [part for part in parts if knob in part.knobs]
    if not found:
        known = sorted({name for part in parts for name in part.knobs})
        raise ConfigError(
            f"No part of this model has a knob {knob!r}.{did_you_mean(knob, known)} "
            f"Its knobs: {', '.join(known) or 'none; there is nothing to trade for run time'}."
        )
    wrappers = [part for part in found if isinstance(part, Uncertainty)]
    return list(wrappers) or list(found)


def tradeoff(
    predictor: Predictor,
    batches: Sequence[Batch],
    metrics: Sequence[Metric],
    *,
    knob: str,
    values: Sequence[int],
    samples: int,
    seed: int,
    repeats: int = 5,
    timed_calls: int = 20,
    budget_seconds: float = 20.0,
) -> list[Turn]:
    """The curve of one trained predictor; its knob, its mode and torch's random numbers are left as they were.

    Args:
        batches: labelled, on the predictor's device; the first is also the one that is timed.
        samples: as of `Prediction`.
        seed: of the first repeat; the others follow it.
        timed_calls, budget_seconds: as of `framework.evaluation.work_precision.run_times`.

    Raises:
        ConfigError: no batch, no value, or no such knob.
    """
    if not batches or not values:
        raise ConfigError(
            f"wanted batches and values of {knob} to try, got {len(batches)} and {len(values)}."
        )
    inputs, target = batches[0]["input"], batches[0]["target"]
    with _undisturbed(predictor, knob), torch.no_grad():
        found = []
        for value in values:
            _turn(predictor, knob, value)
            runs = [
                evaluate(
                    predictor,
                    batches,
                    metrics,
                    groups=("all",),
                    samples=samples,
                    seed=seed + repeat,
                    device=inputs.device,
                ).total
                for repeat in range(repeats)
            ]
            found.append(runs)

        def predict(value: int) -> None:
            _turn(predictor, knob, value)
            predictor(inputs).log_prob(target)

        taken = run_times(predict, values, inputs.device, calls=timed_calls, budget_seconds=budget_seconds)
    return [
        Turn(value, _over(runs, _mean), _over(runs, _spread), 1e3 * seconds / len(inputs))
        for value, runs, seconds in zip(values, found, taken, strict=True)
    ]


def rows(
    curves: Mapping[str, Sequence[Turn]], keys: Sequence[str], lower: Mapping[str, bool], *, synthetic: bool
) -> list[dict[str, object]]:
    """A row per method and value, for `framework.reports.table`, with a column "<key>_pareto" for each metric.

    Args:
        keys: the metrics to tell of.
        lower: whether less of it is better.
    """
    found: list[dict[str, object]] = []
    for method, turns in curves.items():
        times = [turn.milliseconds for turn in turns]
        best = {
            key: front([turn.metrics[key] * (1 if lower[key] else -1) for turn in turns], times)
            for key in keys
        }
        for index, turn in enumerate(turns):
            row: dict[str, object] = {"method": method, "value": turn.value}
            for key in keys:
                row |= {key: turn.metrics[key], f"{key}_std": turn.spreads[key]}
                row[f"{key}_pareto"] = best[key][index]
            row |= {"milliseconds_per_sample": turn.milliseconds, "synthetic": synthetic}
            found.append(row)
    return found


def write(found: Sequence[Mapping[str, object]], path: Path) -> None:
    """Write all columns as CSV."""
    keys = [key for key in found[0] if not key.endswith("_std")]
    table.csv(found, {key: key for key in keys}, path)


def _turn(predictor: Predictor, knob: str, value: int) -> None:
    for part in owners(predictor, knob):
        setattr(part, knob, value)


def _over(runs: Sequence[Mapping[str, float]], of: Callable[[list[float]], float]) -> dict[str, float]:
    return {key: of([run[key] for run in runs]) for key in runs[0]}


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values))


def _spread(values: Sequence[float]) -> float:
    return float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")


@contextmanager
def _undisturbed(predictor: Predictor, knob: str) -> Iterator[None]:
    """Evaluation mode inside; afterwards mode, knob and random numbers are as before."""
    training = predictor.training
    before = [(part, getattr(part, knob)) for part in owners(predictor, knob)]
    device = next(predictor.parameters()).device
    try:
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            predictor.eval()
            yield
    finally:
        for part, value in before:
            setattr(part, knob, value)
        predictor.train(training)


def device_note(predictor: Predictor) -> str:
    """What it ran on, for a caption."""
    return f"{device_name(next(predictor.parameters()).device)}, {torch.get_num_threads()} threads"
