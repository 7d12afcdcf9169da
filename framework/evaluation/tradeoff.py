"""Error against run time for several values of a knob: any metric, and the error of log-likelihoods."""

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
from framework.evaluation.cost import device_name, time_call
from framework.evaluation.pareto import TIME_NOISE, front
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
        numbers: for each metric, its mean over the repeats, "<key>", and their standard deviation, "<key>_std"; with a
            reference, also the numbers that `framework.evaluation.reference.errors` returns.
        milliseconds: median wall time per sample, from input to log-likelihood.
    """

    value: int
    numbers: Mapping[str, float]
    milliseconds: float


@dataclass(frozen=True)
class Curve:
    """Curve of one method: its points in the order of the knob's values, and the conditions of the measurement.

    Attributes:
        knob: name of the knob.
        points: results at each value of the knob.
        reference: log-likelihoods with which those of the points were compared; None if they were not compared.
        repeats: number of seeds for each value.
        samples: number of test samples.
        batch_size: number of samples in the timed batch.
        device: the device, e.g. "cpu (AMD EPYC)".
        threads: number of CPU threads that torch used for one operation.
    """

    knob: str
    points: list[Point]
    reference: Reference | None
    repeats: int
    samples: int
    batch_size: int
    device: str
    threads: int


def knob_owners(predictor: Predictor, knob: str) -> list[Uncertainty | DensityHead]:
    """Return the wrappers with the knob or, if there is no such wrapper, the heads with the knob; [] for `knob=""`.

    Raises:
        ConfigError: no wrapper or head has the knob; the message lists the existing knobs.
    """
    if not knob:
        return []
    parts = parts_with_knobs(predictor)
    with_knob = [part for part in parts if knob in part.knobs]
    if not with_knob:
        known = sorted({name for part in parts for name in part.knobs})
        raise ConfigError(
            f"No part of this model has a knob {knob!r}.{did_you_mean(knob, known)} "
            f"Knobs of the model: {', '.join(known) or 'none; it cannot trade error for run time'}."
        )
    wrappers = [part for part in with_knob if isinstance(part, Uncertainty)]
    return list(wrappers) or list(with_knob)


def first_knob(predictor: Predictor) -> str:
    """Return the first knob of the outermost uncertainty wrapper or head that has knobs.

    Raises:
        ConfigError: no wrapper or head has a knob.
    """
    for part in parts_with_knobs(predictor):
        return next(iter(part.knobs))
    raise ConfigError(
        "No part of this model has a knob, such as the number of members of an ensemble or of samples of a latent "
        "variable. The model cannot trade error for run time; choose a model that has a knob."
    )


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
    """Measure metrics, errors against a reference, and run time of a trained predictor for each value of a knob.

    Run times are measured for the whole predictor, from input to log-likelihood, on the first batch. The predictor's
    mode, its knob and the states of torch's random generators are restored afterwards.

    Args:
        predictor: the trained predictor.
        batches: labelled batches on the predictor's device.
        metrics: metrics to compute at each value.
        knob: name of the knob of the wrappers or heads; "" if no knob is set, so that the values only name the points.
        values: values of the knob to try.
        reference: value of the knob for the reference, at least the largest of `values` and so large that its own error
            is negligible; None: no comparison with a reference.
        samples: number of samples for a point prediction that has no closed form.
        repeats: number of seeds for each value and for the reference; a reference needs at least two.
        seed: seed of all random numbers.
        timed_calls: largest number of timed calls for each value.
        budget_seconds: limit on the duration of all timed calls, of which at least three are made for each value.

    Raises:
        ConfigError: there is no batch, no value or no such knob; the reference is below the largest value; or there are
            too few repeats for a reference.
    """
    all_batches, parts = list(batches), knob_owners(predictor, knob)
    _check(all_batches, parts, knob, values, reference, repeats)
    inputs, target = all_batches[0]["input"], all_batches[0]["target"]

    def set_knob(value: int) -> None:
        for part in parts:
            setattr(part, knob, value)

    def predict(value: int) -> None:
        set_knob(value)
        predictor(inputs).log_prob(target)

    def compute_metrics(value: int, repeat: int) -> dict[str, float]:
        set_knob(value)
        evaluation = evaluate(
            predictor,
            all_batches,
            metrics,
            groups=("all",),
            samples=samples,
            seed=seed + repeat,
            device=inputs.device,
        )
        return evaluation.total

    points: list[Point] = []
    with restored(predictor, parts, knob, inputs.device), torch.no_grad():
        # No two estimates share random numbers.
        *point_seeds, reference_seeds = (
            _seeds(stream, repeats) for stream in np.random.SeedSequence(seed).spawn(len(values) + 1)
        )
        log_probs, reference_result = _log_probs(predictor, all_batches, set_knob), None
        if reference is not None:
            reference_result = reference_value(log_probs, reference, reference_seeds)
        times = run_times(predict, values, inputs.device, calls=timed_calls, budget_seconds=budget_seconds)
        points_to_measure = list(zip(values, point_seeds, times, strict=True))
        for value, seeds, time in track_progress(
            points_to_measure, "measuring errors", len(points_to_measure), f"values of {knob}"
        ):
            numbers = (
                average_runs([compute_metrics(value, repeat) for repeat in range(repeats)]) if metrics else {}
            )
            if reference_result is not None:
                numbers |= errors(log_probs, value, seeds, reference_result)
            points.append(Point(value, numbers, 1e3 * time / len(inputs)))
    count = sum(len(batch["input"]) for batch in all_batches)
    device, threads = device_name(inputs.device), torch.get_num_threads()
    return Curve(knob, points, reference_result, repeats, count, len(inputs), device, threads)


def average_runs(runs: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the mean of each number over the runs and, as "<key>_std", its standard deviation, NaN for one run.

    Standard errors over the samples of a run, "<key>_sem", are left out.
    """
    averages: dict[str, float] = {}
    for key in (key for key in runs[0] if not key.endswith("_sem")):
        numbers = [run[key] for run in runs]
        averages[key] = float(np.mean(numbers))
        averages[f"{key}_std"] = float(np.std(numbers, ddof=1)) if len(numbers) > 1 else math.nan
    return averages


def run_times(
    predict: Callable[[int], object],
    values: Sequence[int],
    device: torch.device,
    *,
    calls: int = 20,
    budget_seconds: float = 20.0,
) -> list[float]:
    """Return the median wall time of `predict(value)` for each value, seconds, after two warm-up calls.

    In every round, each value is timed once, so that a slowdown of the machine affects all values. An untimed call
    precedes each timed call, so that caches filled by another value do not matter. There are `calls` rounds; if these
    would last longer than `budget_seconds`, there are fewer, but at least three. The time of a call ends when `device`,
    on which it computes, has finished.
    """
    times_by_value: list[list[float]] = [[] for _ in values]
    start = perf_counter()
    for round_number in range(calls + 1):
        for value, times in zip(values, times_by_value, strict=True):
            predict(value)
            time = time_call(lambda value=value: predict(value), device)
            if round_number > 0:  # the first round warms up
                times.append(time)
        if round_number >= 3 and perf_counter() - start > budget_seconds:
            break
    return [statistics.median(times) for times in times_by_value]


def rows(
    curves: Mapping[str, Curve], better: Mapping[str, Literal["higher", "lower"]], *, synthetic: bool
) -> list[dict[str, object]]:
    """Return one row per method and knob value, for a result table; the keys of numbers contain their units.

    Args:
        curves: curves by method.
        better: metrics to report, with the direction in which each is better. Each gets a column "<key>_pareto", which
            is true for points on the Pareto front of their own curve (`framework.evaluation.pareto.front`).
        synthetic: whether the data are generated.
    """
    reported_keys = {f"{key}{suffix}" for key in (*better, *COLUMNS) for suffix in ("", "_std", "_sem")}
    table: list[dict[str, object]] = []
    for method, curve in curves.items():
        times, repeats = [point.milliseconds for point in curve.points], curve.repeats
        best = {}
        for key, direction in better.items():
            sign = 1 if direction == "lower" else -1
            means = [mean({**point.numbers, "repeats": repeats}, key, repeats) for point in curve.points]
            signed = [replace(value, value=sign * value.value) for value in means]
            best[f"{key}_pareto"] = front(signed, times, TIME_NOISE)
        circumstances: dict[str, object] = {"repeats": repeats}
        if curve.reference is not None:
            circumstances["reference_value"] = curve.reference.value
            circumstances["reference_log_likelihood_nats"] = curve.reference.mean
            circumstances["reference_log_likelihood_nats_sem"] = curve.reference.standard_error
        circumstances |= {"samples": curve.samples, "batch_size": curve.batch_size}
        circumstances |= {"device": curve.device, "threads": curve.threads, "synthetic": synthetic}
        for index, point in enumerate(curve.points):
            row: dict[str, object] = {"method": method, "value": point.value, "knob": curve.knob}
            row |= {key: number for key, number in point.numbers.items() if key in reported_keys}
            row |= {key: on_front[index] for key, on_front in best.items()}
            table.append({**row, "milliseconds_per_sample": point.milliseconds, **circumstances})
    return table


def _log_probs(predictor: Predictor, batches: Sequence[Batch], set_knob: Callable[[int], None]) -> LogProbs:
    """Return the function that computes the log-likelihoods of all samples at a knob value and a seed."""

    def identity(inputs: Tensor) -> Tensor:
        return inputs

    density, encode = (
        (predictor.head, predictor.raw) if isinstance(predictor, Model) else (predictor, identity)
    )

    @cache  # a model's encoder runs once, because the knob belongs to its head
    def pairs() -> list[tuple[Tensor, Tensor]]:
        return [(encode(batch["input"]), batch["target"]) for batch in batches]

    def log_probs(value: int, seed: int) -> Tensor:
        set_knob(value)
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
        raise ConfigError(
            "Got no batch of data, but error against run time is measured on at least one batch. Give at least one "
            "batch."
        )
    if not values:
        advice = f", for example {parts[0].knobs[knob]} for {type(parts[0]).__name__}" if parts else ""
        raise ConfigError(f"Got no values of {knob}. Give at least one value{advice}.")
    if reference is None:
        return
    if reference < max(values):
        raise ConfigError(
            f"The reference {knob}={reference} is below the largest value of the curve, {max(values)}. Set the "
            "reference to a larger value."
        )
    if repeats < 2:
        raise ConfigError(
            f"repeats = {repeats}, but at least 2 are required for standard errors. Raise repeats."
        )


@contextmanager
def restored(
    predictor: Predictor, parts: Sequence[Uncertainty | DensityHead], knob: str, device: torch.device
) -> Iterator[None]:
    """Set evaluation mode inside the block; afterwards restore the mode, the knob and the random generators.

    Args:
        predictor: the predictor.
        parts: wrappers or heads of the predictor that have the knob.
        knob: name of the knob.
        device: device of the predictor, whose random generator is restored.
    """
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
    """Return `count` seeds from a seed sequence."""
    return [int(seed) for seed in stream.generate_state(count, np.uint64) >> np.uint64(1)]
