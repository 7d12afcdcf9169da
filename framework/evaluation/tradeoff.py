"""Error against run time as a knob is turned: any metric, and the error of log-likelihoods against a reference."""

import math
import statistics
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from time import perf_counter
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from framework.data import Batch
from framework.density_head import DensityHead
from framework.errors import ConfigError, did_you_mean
from framework.evaluation.cost import device_name, seconds
from framework.evaluation.pareto import TIMES_APART, front
from framework.evaluation.reference import COLUMNS, LogProbs, Reference, errors, reference_value
from framework.evaluation.significance import mean
from framework.evaluation.splits import evaluate
from framework.metric import Metric
from framework.model import Model, Predictor
from framework.storage.progress import track_progress
from framework.uncertainty import Uncertainty


@dataclass(frozen=True)
class Point:
    """Results at one value of a knob.

    Attributes:
        value: value of the knob.
        numbers: for each metric "<key>" its mean over the repeats, and "<key>_std", their standard deviation; also the
            numbers that `framework.evaluation.reference.errors` returns.
        milliseconds: median wall time per sample, from input to log-likelihood.
    """

    value: int
    numbers: Mapping[str, float]
    milliseconds: float


@dataclass(frozen=True)
class Curve:
    """Points of one method, in the order of the knob's values, and the conditions of the measurement."""

    knob: str
    points: list[Point]
    reference: Reference | None
    repeats: int
    samples: int
    batch_size: int
    device: str
    threads: int


def owners(predictor: Predictor, knob: str) -> list[Uncertainty | DensityHead]:
    """Return the parts that have a knob of that name: wrappers, or else heads; no parts for the name "".

    Raises:
        ConfigError: no part has the knob; the message lists the existing knobs.
    """
    if not knob:
        return []
    parts = parts_with_knobs(predictor)
    found = [part for part in parts if knob in part.knobs]
    if not found:
        known = sorted({name for part in parts for name in part.knobs})
        raise ConfigError(
            f"No part of this model has a knob {knob!r}.{did_you_mean(knob, known)} "
            f"Its knobs: {', '.join(known) or 'none; there is nothing to trade for run time'}."
        )
    wrappers = [part for part in found if isinstance(part, Uncertainty)]
    return list(wrappers) or list(found)


def first_knob(predictor: Predictor) -> str:
    """Return the first knob of the outermost part that has knobs.

    Raises:
        ConfigError: no part has a knob.
    """
    for part in parts_with_knobs(predictor):
        return next(iter(part.knobs))
    raise ConfigError("No part of this model has a knob: there is nothing to trade for run time.")


def parts_with_knobs(predictor: Predictor) -> list[Uncertainty | DensityHead]:
    """Return the wrappers and heads that have knobs, from the outermost to the innermost."""
    parts = [part for part in predictor.modules() if isinstance(part, Uncertainty | DensityHead)]
    return [part for part in parts if part.knobs]


def tradeoff(
    predictor: Predictor,
    batches: Iterable[Batch],
    metrics: Sequence[Metric] = (),
    *,
    knob: str,
    values: Sequence[int],
    reference: int | None = None,
    samples: int = 1,
    repeats: int = 5,
    seed: int = 0,
    timed_calls: int = 20,
    budget_seconds: float = 20.0,
) -> Curve:
    """Return the curve of a trained predictor: metrics, and errors against a reference, for each value of its knob.

    The times are those of the whole predictor, from input to log-likelihood, on the first batch. The predictor, its
    knob and torch's random numbers are left as they were.

    Args:
        predictor: the trained predictor.
        batches: labelled batches on the predictor's device.
        metrics: metrics to compute at each value.
        knob: name of the knob, as in `owners`.
        values: values of the knob to try.
        reference: a value so large that its own error does not matter, at least the largest of `values`; None: no
            comparison with a reference.
        samples: as in `Prediction`.
        repeats: number of seeds for each value and for the reference, which needs two.
        seed: seed of all random numbers.
        timed_calls: number of timed calls, as in `run_times`.
        budget_seconds: limit of the timing, as in `run_times`.

    Raises:
        ConfigError: there is no batch, no value or no such knob; the reference is below the largest value; or there are
            too few repeats for a reference.
    """
    kept, parts = list(batches), owners(predictor, knob)
    _check(kept, parts, knob, values, reference, repeats)
    inputs, target = kept[0]["input"], kept[0]["target"]

    def turn(value: int) -> None:
        for part in parts:
            setattr(part, knob, value)

    def predict(value: int) -> None:
        turn(value)
        predictor(inputs).log_prob(target)

    def measured(value: int, repeat: int) -> dict[str, float]:
        turn(value)
        found = evaluate(
            predictor,
            kept,
            metrics,
            groups=("all",),
            samples=samples,
            seed=seed + repeat,
            device=inputs.device,
        )
        return found.total

    points: list[Point] = []
    with _undisturbed(predictor, parts, knob, inputs.device), torch.no_grad():
        # No two estimates share random numbers.
        *own, last = (
            _seeds(stream, repeats) for stream in np.random.SeedSequence(seed).spawn(len(values) + 1)
        )
        log_probs, compared = _log_probs(predictor, kept, turn), None
        if reference is not None:
            compared = reference_value(log_probs, reference, last)
        taken = run_times(predict, values, inputs.device, calls=timed_calls, budget_seconds=budget_seconds)
        turns = list(zip(values, own, taken, strict=True))
        for value, seeds, time in track_progress(turns, "measuring errors", len(turns), f"values of {knob}"):
            numbers = averaged([measured(value, repeat) for repeat in range(repeats)]) if metrics else {}
            if compared is not None:
                numbers |= errors(log_probs, value, seeds, compared)
            points.append(Point(value, numbers, 1e3 * time / len(inputs)))
    count = sum(len(batch["input"]) for batch in kept)
    device, threads = device_name(inputs.device), torch.get_num_threads()
    return Curve(knob, points, compared, repeats, count, len(inputs), device, threads)


def averaged(runs: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return for each number its mean over the runs and, as "<key>_std", its standard deviation, NaN for one run.

    The standard errors "<key>_sem" over the samples of a run are left out.
    """
    found: dict[str, float] = {}
    for key in (key for key in runs[0] if not key.endswith("_sem")):
        numbers = [run[key] for run in runs]
        found[key] = float(np.mean(numbers))
        found[f"{key}_std"] = float(np.std(numbers, ddof=1)) if len(numbers) > 1 else math.nan
    return found


def run_times(
    predict: Callable[[int], object],
    values: Sequence[int],
    device: torch.device,
    *,
    calls: int = 20,
    budget_seconds: float = 20.0,
) -> list[float]:
    """Return the median wall time of `predict(value)` for each value, seconds, after two calls to warm up.

    The values take turns, so that a machine that slows down affects all of them. An untimed call precedes each timed
    call, so that no call pays for the caches that another value left behind. If the turns would last longer than
    `budget_seconds`, there are fewer than `calls`, but at least three.
    """
    taken: list[list[float]] = [[] for _ in values]
    start = perf_counter()
    for turn in range(calls + 1):
        for value, times in zip(values, taken, strict=True):
            predict(value)
            time = seconds(lambda value=value: predict(value), device)
            if turn > 0:  # the first turn is to warm up
                times.append(time)
        if turn >= 3 and perf_counter() - start > budget_seconds:
            break
    return [statistics.median(times) for times in taken]


def rows(
    curves: Mapping[str, Curve], better: Mapping[str, Literal["higher", "lower"]], *, synthetic: bool
) -> list[dict[str, object]]:
    """Return one row per method and value for a result table; the key of a number with a unit contains the unit.

    Args:
        curves: curves by method.
        better: metrics to report, with the direction in which each is better. Each gets a column "<key>_pareto", which
            is true on the front of its own curve, beyond noise (`framework.evaluation.pareto.front`).
        synthetic: whether the data are generated.
    """
    told = {f"{key}{suffix}" for key in (*better, *COLUMNS) for suffix in ("", "_std", "_sem")}
    found: list[dict[str, object]] = []
    for method, curve in curves.items():
        times, repeats = [point.milliseconds for point in curve.points], curve.repeats
        best = {}
        for key, way in better.items():
            sign = 1 if way == "lower" else -1
            means = [mean({**point.numbers, "repeats": repeats}, key, repeats) for point in curve.points]
            signed = [replace(one, value=sign * one.value) for one in means]
            best[f"{key}_pareto"] = front(signed, times, TIMES_APART)
        circumstances: dict[str, object] = {"repeats": repeats}
        if curve.reference is not None:
            circumstances["reference_value"] = curve.reference.value
            circumstances["reference_log_likelihood_nats"] = curve.reference.mean
            circumstances["reference_log_likelihood_nats_sem"] = curve.reference.standard_error
        circumstances |= {"samples": curve.samples, "batch_size": curve.batch_size}
        circumstances |= {"device": curve.device, "threads": curve.threads, "synthetic": synthetic}
        for index, point in enumerate(curve.points):
            row: dict[str, object] = {"method": method, "value": point.value, "knob": curve.knob}
            row |= {key: number for key, number in point.numbers.items() if key in told}
            row |= {key: kept[index] for key, kept in best.items()}
            found.append({**row, "milliseconds_per_sample": point.milliseconds, **circumstances})
    return found


def _log_probs(predictor: Predictor, batches: Sequence[Batch], turn: Callable[[int], None]) -> LogProbs:
    """Return the function that computes log-likelihoods of all samples at a value and a seed."""

    def unchanged(inputs: Tensor) -> Tensor:
        return inputs

    density, read = (
        (predictor.head, predictor.raw) if isinstance(predictor, Model) else (predictor, unchanged)
    )

    @cache  # the encoder of a model runs once, because the knob belongs to the head
    def pairs() -> list[tuple[Tensor, Tensor]]:
        return [(read(batch["input"]), batch["target"]) for batch in batches]

    def log_probs(value: int, seed: int) -> Tensor:
        turn(value)
        torch.manual_seed(seed)
        return torch.cat([density(numbers).log_prob(target) for numbers, target in pairs()])

    return log_probs


def _check(
    batches: Sequence[Batch],
    parts: Sequence[Uncertainty | DensityHead],
    knob: str,
    values: Sequence[int],
    reference: int | None,
    repeats: int,
) -> None:
    if not batches:
        raise ConfigError("Error against run time is measured on at least one batch, got none.")
    if not values:
        worth = f"; those of {type(parts[0]).__name__} worth trying: {parts[0].knobs[knob]}" if parts else ""
        raise ConfigError(f"No values of {knob} to try{worth}.")
    if reference is None:
        return
    if reference < max(values):
        raise ConfigError(
            f"The reference {knob}={reference} is below the largest value tried, {max(values)}; wanted more."
        )
    if repeats < 2:
        raise ConfigError(f"repeats = {repeats}: two at least are needed to know an error's error.")


@contextmanager
def _undisturbed(
    predictor: Predictor, parts: Sequence[Uncertainty | DensityHead], knob: str, device: torch.device
) -> Iterator[None]:
    """Set evaluation mode inside the block, and restore mode, knob and random numbers afterwards."""
    training = predictor.training
    before = [getattr(part, knob) for part in parts]
    try:
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            predictor.eval()
            yield
    finally:
        for part, value in zip(parts, before, strict=True):
            setattr(part, knob, value)
        predictor.train(training)


def _seeds(stream: np.random.SeedSequence, count: int) -> list[int]:
    """Return `count` seeds of a stream of random numbers."""
    return [int(seed) for seed in stream.generate_state(count, np.uint64) >> np.uint64(1)]
