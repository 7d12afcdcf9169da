"""The work-precision diagram: the error of a log-likelihood against its run time as a knob is turned."""

import math
import statistics
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from framework.data import Batch
from framework.errors import ConfigError, did_you_mean
from framework.evaluation.cost import device_name, seconds
from framework.model import Model
from framework.reports import table

COLUMNS = {
    "method": "method",
    "value": "knob",
    "error_nats": "error nats",
    "bias_nats": "bias nats",
    "sample_error_nats": "one sample's error nats",
    "log_likelihood_nats": "log-likelihood nats",
    "milliseconds_per_sample": "ms / sample",
    "pareto": "Pareto",
}
"""The columns of `rows` that belong in a table, with their headings."""


@dataclass(frozen=True)
class Point:
    """What one value of a knob gives.

    Attributes:
        knob, value: the knob's name and where it stood.
        error: root mean square, over repeats with other seeds, of mean log-likelihood minus reference, nats.
        error_sem: standard error of `error` over the repeats, nats; NaN for one repeat.
        milliseconds: median wall time per sample, from input to log-likelihood.
        bias: absolute difference of `log_likelihood` and the reference, nats.
        log_likelihood: averaged over samples and repeats, nats.
        log_likelihood_sem: its standard error over the repeats, nats.
        sample_error: root mean square, over repeats and samples, of one sample's log-likelihood minus its
            reference, nats: what a user who asks about one sample sees.
        repeats: how many seeds.
    """

    knob: str
    value: int | float
    error: float
    error_sem: float
    milliseconds: float
    bias: float = math.nan
    log_likelihood: float = math.nan
    log_likelihood_sem: float = math.nan
    sample_error: float = math.nan
    repeats: int = 1


@dataclass(frozen=True)
class Reference:
    """What the estimates are compared with.

    Attributes:
        value: where the knob stood.
        log_likelihoods: of each sample, nats: the logarithm of the density averaged over the repeats.
        log_likelihood: their mean.
        standard_error: of that mean, over the repeats (jackknife), nats; errors below it mean nothing.
        repeats: how many seeds.
    """

    value: int
    log_likelihoods: Float[Tensor, "samples"]
    log_likelihood: float
    standard_error: float
    repeats: int


@dataclass(frozen=True)
class Curve:
    """The points of one method, in the order of the knob's values, and how they were measured."""

    points: list[Point]
    reference: Reference
    samples: int
    batch_size: int
    device: str
    threads: int


def work_precision(
    model: Model,
    batches: Iterable[Batch],
    *,
    knob: str,
    values: Sequence[int],
    reference: int,
    repeats: int = 8,
    seed: int = 0,
    timed_calls: int = 20,
    budget_seconds: float = 20.0,
) -> Curve:
    """The curve of one trained model.

    The errors come from the numbers the head reads, which the encoder computes once, since the knob is the
    head's. The times are those of the whole predictor, input to log-likelihood, on the first batch. The
    model, its knob and torch's random numbers are left as they were.

    Args:
        model: its head has the knob.
        batches: labelled, on the model's device; the first one is also the one that is timed.
        knob: an attribute in `model.head.knobs`.
        values: of the knob, to be tried.
        reference: a value so large that its own error does not matter; should exceed the largest of `values`.
        repeats: seeds for each value and for the reference; two at least.
        seed: of all random numbers.
        timed_calls: calls timed for each value; fewer (but three) once `budget_seconds` are over.

    Raises:
        ConfigError: the head has no such knob, or the reference is below the largest value.
    """
    _check(model, knob, values, reference, repeats)
    with _undisturbed(model, knob), torch.no_grad():
        kept = list(batches)
        if not kept:
            raise ConfigError("The work-precision diagram needs at least one batch, got none.")
        read = [(model.raw(batch["input"]), batch["target"]) for batch in kept]

        def log_likelihoods(value: int, seed: int) -> Tensor:
            setattr(model.head, knob, value)
            torch.manual_seed(seed)
            return torch.cat([model.head(raw).log_prob(target) for raw, target in read])

        streams = np.random.SeedSequence(seed).spawn(len(values) + 1)  # no two estimates share random numbers
        truth = reference_value(log_likelihoods, reference, _seeds(streams[-1], repeats))
        inputs, target = kept[0]["input"], kept[0]["target"]

        def predict(value: int) -> None:
            setattr(model.head, knob, value)
            model(inputs).log_prob(target)

        taken = run_times(predict, values, inputs.device, calls=timed_calls, budget_seconds=budget_seconds)
        points = [
            estimate(log_likelihoods, knob, value, _seeds(stream, repeats), truth, 1e3 * time / len(inputs))
            for value, stream, time in zip(values, streams[:-1], taken, strict=True)
        ]
    return Curve(
        points=points,
        reference=truth,
        samples=len(truth.log_likelihoods),
        batch_size=len(inputs),
        device=device_name(inputs.device),
        threads=torch.get_num_threads(),
    )


def reference_value(
    log_likelihoods: Callable[[int, int], Tensor], value: int, seeds: Sequence[int]
) -> Reference:
    """The log-likelihood at a large value of the knob, averaged over seeds.

    The densities are averaged, not their logarithms: where the knob counts Monte Carlo samples this equals
    one estimate with len(seeds) times as many, and the bias of the logarithm (Jensen) shrinks as much. The
    standard error is the jackknife's over the seeds, sqrt((R - 1)/R Σ_r (θ_(r) - θ_(·))²) (Efron &
    Tibshirani 1993, eq. 11.5).

    Args:
        log_likelihoods: (value, seed) → (samples,), nats.
        seeds: two at least.

    Raises:
        ValueError: a log-likelihood is not finite; there is nothing to compare with.
    """
    found = torch.stack([log_likelihoods(value, seed) for seed in seeds]).double()  # (repeats, samples)
    pooled = torch.logsumexp(found, 0) - math.log(len(seeds))
    wrong = (~pooled.isfinite()).nonzero()
    if len(wrong):
        raise ValueError(
            f"The reference log-likelihood of sample {int(wrong[0])} is {pooled[wrong[0]].item()} "
            f"({len(wrong)} such); wanted finite numbers. Raise the reference's value, or mend the head."
        )
    left_out = torch.stack(
        [torch.cat([found[:r], found[r + 1 :]]).logsumexp(0).mean() for r in range(len(seeds))]
    )
    spread = (left_out - left_out.mean()).square().sum() * (len(seeds) - 1) / len(seeds)
    return Reference(value, pooled, float(pooled.mean()), float(spread.sqrt()), len(seeds))


def estimate(
    log_likelihoods: Callable[[int, int], Tensor],
    knob: str,
    value: int,
    seeds: Sequence[int],
    reference: Reference,
    milliseconds: float,
) -> Point:
    """The errors at one value of the knob against the reference; infinite where a log-likelihood is.

    The standard error of the root mean square sqrt(m) is that of m divided by 2 sqrt(m) (delta method).
    """
    found = torch.stack([log_likelihoods(value, seed) for seed in seeds]).double()  # (repeats, samples)
    means = found.mean(1)
    squares = (means - reference.log_likelihood).square()
    error = float(squares.mean().sqrt())
    return Point(
        knob=knob,
        value=value,
        error=error,
        error_sem=_standard_error(squares) / (2 * error) if error > 0 else 0.0,
        milliseconds=milliseconds,
        bias=abs(float(means.mean()) - reference.log_likelihood),
        log_likelihood=float(means.mean()),
        log_likelihood_sem=_standard_error(means),
        sample_error=float((found - reference.log_likelihoods).square().mean().sqrt()),
        repeats=len(seeds),
    )


def run_times(
    predict: Callable[[int], object],
    values: Sequence[int],
    device: torch.device,
    *,
    calls: int = 20,
    budget_seconds: float = 20.0,
) -> list[float]:
    """Median wall time of `predict(value)` for each value, seconds, after two calls to warm up.

    The values take turns, so that a machine that slows down meanwhile slows all of them; an untimed call goes
    before each timed one, so that none pays for the caches its neighbour left behind. Where turns would last
    longer than `budget_seconds`, there are fewer than `calls`, but three.
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


def pareto(points: Sequence[Point]) -> list[bool]:
    """Which points no other beats: none has less error in no more time, or less time with no more error."""
    return front([point.error for point in points], [point.milliseconds for point in points])


def front(errors: Sequence[float], times: Sequence[float]) -> list[bool]:
    """Pareto front of two quantities to be small: equal pairs are both on it, what is not finite is not."""
    finite = [
        index for index, pair in enumerate(zip(errors, times, strict=True)) if all(map(math.isfinite, pair))
    ]
    kept = [False] * len(errors)
    least, when = math.inf, math.nan
    for index in sorted(finite, key=lambda index: (times[index], errors[index])):
        error, time = errors[index], times[index]
        if error < least or (error == least and time == when):
            kept[index] = True
            least, when = error, time
    return kept


def rows(curves: Mapping[str, Curve], *, synthetic: bool) -> list[dict[str, object]]:
    """A row per method and value, for `framework.reports.table`; every number has its unit in its key."""
    return [
        {
            "method": method,
            "knob": point.knob,
            "value": point.value,
            "error_nats": point.error,
            "error_nats_sem": point.error_sem,
            "bias_nats": point.bias,
            "sample_error_nats": point.sample_error,
            "log_likelihood_nats": point.log_likelihood,
            "log_likelihood_nats_sem": point.log_likelihood_sem,
            "milliseconds_per_sample": point.milliseconds,
            "pareto": best,
            "repeats": point.repeats,
            "reference_value": curve.reference.value,
            "reference_log_likelihood_nats": curve.reference.log_likelihood,
            "reference_log_likelihood_nats_sem": curve.reference.standard_error,
            "samples": curve.samples,
            "batch_size": curve.batch_size,
            "device": curve.device,
            "threads": curve.threads,
            "synthetic": synthetic,
        }
        for method, curve in curves.items()
        for point, best in zip(curve.points, pareto(curve.points), strict=True)
    ]


def write(curves: Mapping[str, Curve], path: Path, *, synthetic: bool) -> None:
    """Write all numbers as CSV."""
    found = rows(curves, synthetic=synthetic)
    keys = [key for key in found[0] if not key.endswith("_sem")] if found else list(COLUMNS)
    table.csv(found, {key: key for key in keys}, path)


def _check(model: Model, knob: str, values: Sequence[int], reference: int, repeats: int) -> None:
    known = model.head.knobs
    head = type(model.head).__name__
    if knob not in known:
        raise ConfigError(
            f"{head} has no knob {knob!r}.{did_you_mean(knob, known)} "
            f"Its knobs: {', '.join(known) or 'none; there is nothing to trade for run time'}."
        )
    if not values:
        raise ConfigError(f"No values of {knob} to try; those of {head} worth trying: {known[knob]}.")
    if reference < max(values):
        raise ConfigError(
            f"The reference {knob}={reference} is below the largest value tried, {max(values)}; wanted more."
        )
    if repeats < 2:
        raise ConfigError(f"repeats = {repeats}: two at least are needed to know an error's error.")


@contextmanager
def _undisturbed(model: Model, knob: str) -> Iterator[None]:
    """Evaluation mode inside; afterwards mode, knob and random numbers are as before."""
    training = model.training
    value = getattr(model.head, knob)
    device = next(model.parameters()).device
    try:
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            model.eval()
            yield
    finally:
        setattr(model.head, knob, value)
        model.train(training)


def _seeds(stream: np.random.SeedSequence, count: int) -> list[int]:
    return [int(seed) for seed in stream.generate_state(count, np.uint64) >> np.uint64(1)]


def _standard_error(values: Tensor) -> float:
    """Of the mean of independent values; NaN for one."""
    return float(values.std() / len(values) ** 0.5) if len(values) > 1 else math.nan
