"""Cheapest setting of a model's knobs that meets a limit of run time or error, measured on this machine.

The run times come from `run_times`, and the errors from `evaluate`, as in mode=work_precision. Before a setting is
accepted, the limited quantity is measured once more with this setting: the run time, or the error with other random
numbers. So no setting meets the limit only because chance made its first measurement good.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import product

import torch
from torch.utils.data import Dataset

from framework.configuration.settings import BudgetSettings
from framework.data import Batch, Data
from framework.datasets.fields import fetch
from framework.density_head import DensityHead
from framework.distributions.noise import Draw
from framework.errors import ConfigError, did_you_mean, significant
from framework.evaluation.cost import device_name
from framework.evaluation.significance import Difference, paired_difference
from framework.evaluation.splits import BLOCK, evaluate, predict, silence
from framework.evaluation.tradeoff import first_knob, knob_owners, parts_with_knobs, restored, run_times
from framework.metric import Metric
from framework.model import Predictor
from framework.prediction import Prediction
from framework.storage.progress import track_progress
from framework.uncertainty import Uncertainty

MOST_SAMPLES = 10 * BLOCK
"""Largest number of validation samples with which errors are measured."""
LEAST_BATCHES = 10
"""Smallest number of batches into which the validation samples are divided; settings are compared batch by batch."""
CPU = torch.device("cpu")

Setting = tuple[int, ...]
"""Values of the knobs of a model, in the order of `Knobs.names`."""


@dataclass(frozen=True)
class Knobs:
    """Knobs of a predictor.

    Attributes:
        names: names of the knobs, the outermost part first.
        owners: for each knob, the wrappers or heads that have it (`knob_owners`).
    """

    names: tuple[str, ...]
    owners: tuple[list[Uncertainty | DensityHead], ...]

    @classmethod
    def of(cls, predictor: Predictor) -> "Knobs":
        """Return all knobs of a predictor.

        Raises:
            ConfigError: the predictor has no knob.
        """
        first_knob(predictor)
        names = tuple(dict.fromkeys(name for part in parts_with_knobs(predictor) for name in part.knobs))
        return cls(names, tuple(knob_owners(predictor, name) for name in names))

    @property
    def current(self) -> Setting:
        """Values that the knobs have now."""
        return tuple(getattr(parts[0], name) for name, parts in zip(self.names, self.owners, strict=True))

    def settings(self) -> list[Setting]:
        """Return all combinations of values of the knobs.

        A knob takes the values that its part of the predictor declares, and its present value.
        """
        present = self.current
        return list(
            product(
                *(
                    sorted({*parts[0].knobs[name], value})
                    for name, parts, value in zip(self.names, self.owners, present, strict=True)
                )
            )
        )

    def set(self, setting: Setting) -> None:
        """Set each knob to its value in `setting`."""
        for name, parts, value in zip(self.names, self.owners, setting, strict=True):
            for part in parts:
                setattr(part, name, value)

    def text(self, setting: Setting) -> str:
        """Return a setting as text, for example "members=2, samples=50"."""
        return ", ".join(f"{name}={value}" for name, value in zip(self.names, setting, strict=True))


@dataclass(frozen=True)
class Measure:
    """The one number of a metric that serves as the error of a setting.

    Attributes:
        metric: metric that computes the number.
        key: key of the number.
        sign: 1 if a lower number is better, and -1 if a higher one is.
    """

    metric: Metric
    key: str
    sign: int

    @classmethod
    def of(cls, metrics: Sequence[Metric], key: str | None) -> "Measure":
        """Return the number `key` of `metrics` as a measure of the error.

        If `key` is None, the measure is the first number that is better if it is lower or, without such a number, the
        first number.

        Raises:
            ConfigError: no metric has such a number.
        """
        measures = {
            name: cls(metric, name, 1 if metric.better[name] == "lower" else -1)
            for metric in metrics
            for name in metric.columns
            if name in metric.better and "outliers" not in metric.splits
        }
        if key is None:
            key = next(
                (name for name, measure in measures.items() if measure.sign > 0), next(iter(measures), "")
            )
        if key not in measures:
            raise ConfigError(
                f"budget.metric = {key!r} cannot be the error of a budget. It must be a number for which a metric "
                f"states whether higher or lower is better.{did_you_mean(key, measures)} The metrics of this model "
                f"have {', '.join(measures) or 'no such number'}."
            )
        return measures[key]


@dataclass(frozen=True)
class Errors:
    """Error of a setting on the validation samples.

    Attributes:
        value: the measure over all samples.
        standard_error: its standard error over the samples; NaN if the metric states none.
        batches: the measure of each batch.
    """

    value: float
    standard_error: float
    batches: tuple[float, ...]

    def text(self) -> str:
        """Return the value with its standard error."""
        known = math.isfinite(self.standard_error)
        return significant(self.value, 4) + (f" ± {significant(self.standard_error, 2)}" if known else "")


def meet_budget(
    predictor: Predictor,
    data: Data,
    metrics: Sequence[Metric],
    budget: BudgetSettings,
    *,
    samples: int,
    seed: int,
    batch_size: int = BLOCK,
    work: Callable[[Prediction], object] = lambda prediction: prediction.point,
) -> str:
    """Set the knobs of a trained predictor to the cheapest setting that meets a budget, and say why in a sentence.

    With a limit of the run time, the settings within the limit are compared. A setting counts as equal to the one with
    the lowest error if the difference of their errors is at most the standard error of this difference
    (`Bench.equals`). Of these equal settings, the fastest is chosen. With a limit of the error, the fastest setting
    whose error on the validation samples is within the limit is chosen.

    Args:
        predictor: the predictor, in evaluation mode; its knobs are set.
        data: prepared data, whose validation split is used.
        metrics: metrics from which `budget.metric` is chosen.
        budget: the limit.
        samples: number of samples for a point prediction that has no closed form.
        seed: seed of all random numbers.
        batch_size: number of samples in the timed batch, if `budget.batch_size` is None.
        work: function that computes what the user needs from a prediction. Its run time is part of the measured run
            time, as is that of the metric.

    Raises:
        ConfigError: the predictor has no knob, no metric computes `budget.metric`, or no setting meets the budget; the
            message names the nearest setting.
    """
    knobs, measure = Knobs.of(predictor), Measure.of(metrics, budget.metric)
    bench = Bench(predictor, data.splits().validation, knobs, measure, samples, seed, work)
    count = budget.batch_size or batch_size
    stored = knobs.current
    with ExitStack() as stack, torch.no_grad(), silence():
        for name, parts in zip(knobs.names, knobs.owners, strict=True):
            stack.enter_context(restored(predictor, parts, name, CPU))
        bench.time_batch(count)
        if budget.milliseconds is not None:
            chosen, why = _within_time(bench, budget.milliseconds)
        else:
            assert budget.error is not None
            chosen, why = _within_error(bench, budget.error)
        milliseconds, errors = bench.milliseconds[chosen], bench.errors(chosen, 1)
        beside = (
            "" if chosen == stored else f" Before, {knobs.text(stored)} took {bench.compare(stored, chosen)}."
        )
    knobs.set(chosen)
    place = f"{device_name(CPU)} with threads={torch.get_num_threads()}"
    return (
        f"budget: {knobs.text(chosen)} takes {significant(milliseconds, 3)} ms per sample with {measure.key} "
        f"{errors.text()}; {why}.{beside} Measured on {place}, in batches of {len(bench.timed['input'])}, errors with "
        f"the first {bench.count} validation samples."
    )


class Bench:
    """Measurements of settings, each made once.

    Args:
        predictor: the predictor.
        validation: validation split.
        knobs: knobs of the predictor.
        measure: measure of the error.
        samples: number of samples for a point prediction that has no closed form.
        seed: seed of all random numbers.
        work: function that computes what the user needs from a prediction; its run time counts.

    Attributes:
        milliseconds: run time per sample of each setting, ms.
        count: number of validation samples with which errors are measured.
        timed: batch with which run times are measured.
    """

    timed: Batch

    def __init__(
        self,
        predictor: Predictor,
        validation: Dataset[Batch],
        knobs: Knobs,
        measure: Measure,
        samples: int,
        seed: int,
        work: Callable[[Prediction], object],
    ) -> None:
        self.predictor, self.validation, self.knobs, self.measure = predictor, validation, knobs, measure
        self.samples, self.seed, self.work = samples, seed, work
        self.count = min(len(validation), MOST_SAMPLES)  # type: ignore[arg-type]
        self.milliseconds: dict[Setting, float] = {}
        self._errors: dict[tuple[Setting, int], Errors] = {}

    def time_batch(self, size: int) -> None:
        """Measure the run time of every setting on a batch of `size` validation samples, and keep the batch."""
        size = min(size, len(self.validation))  # type: ignore[arg-type]
        self.timed = fetch(self.validation, range(size))
        settings = self.knobs.settings()
        self.milliseconds = dict(zip(settings, self._times(settings, calls=3), strict=True))

    def time_again(self, setting: Setting) -> float:
        """Measure the run time of one setting again, with more calls, and return it, ms per sample."""
        (self.milliseconds[setting],) = self._times([setting], calls=20)
        return self.milliseconds[setting]

    def _times(self, settings: Sequence[Setting], calls: int) -> list[float]:
        reads = self.measure.metric.reads
        metric = self.measure.metric.clone()

        def compute(index: int) -> None:
            self.knobs.set(settings[index])
            prediction = predict(self.predictor, self.timed, self.samples, Draw(self.seed, 0), reads=reads)
            self.work(prediction)
            metric.update(prediction)
            metric.reset()

        seconds = run_times(compute, range(len(settings)), CPU, calls=calls, budget_seconds=10.0)
        return [1e3 * time / len(self.timed["input"]) for time in seconds]

    def errors(self, setting: Setting, repeat: int = 0) -> Errors:
        """Return the error of a setting; different values of `repeat` use different random numbers."""
        if (setting, repeat) not in self._errors:
            self._errors[setting, repeat] = self._measure(setting, self.seed + repeat)
        return self._errors[setting, repeat]

    def _measure(self, setting: Setting, seed: int) -> Errors:
        size = max(1, min(BLOCK, self.count // LEAST_BATCHES))
        starts = range(0, self.count, size)
        names = [str(number) for number in range(len(starts))]

        def batches() -> Iterator[Batch]:
            for number, start in enumerate(starts):
                batch = fetch(self.validation, range(start, min(start + size, self.count)))
                yield {**batch, "group": torch.full((len(batch["input"]),), number)}

        self.knobs.set(setting)
        evaluation = evaluate(
            self.predictor,
            batches(),
            [self.measure.metric],
            groups=names,
            samples=self.samples,
            seed=seed,
            device=CPU,
        )
        key = self.measure.key
        return Errors(
            evaluation.total[key],
            evaluation.total.get(f"{key}_sem", math.nan),
            tuple(evaluation.groups[name][key] for name in names if name in evaluation.groups),
        )

    def worse(self, setting: Setting, other: Setting) -> Difference:
        """Return by how much the error of `setting` exceeds that of `other`.

        The result is the mean of the paired differences: one difference for each batch of validation samples in which
        both errors are finite.
        """
        pairs = zip(self.errors(setting).batches, self.errors(other).batches, strict=True)
        finite = [pair for pair in pairs if all(map(math.isfinite, pair))]
        return paired_difference(*([self.measure.sign * pair[side] for pair in finite] for side in (0, 1)))

    def equals(self, setting: Setting, best: Setting) -> bool:
        """Return whether the error of `setting` exceeds that of `best` by at most one standard error, or by rounding.

        The standard error is that of the paired difference of the two errors (`worse`). The rule is the
        one-standard-error rule of Breiman et al. (1984), "Classification and regression trees", section 3.4.3, which
        uses the standard error of the best setting instead.
        """
        difference = self.worse(setting, best)
        # Each comparison is False if its limit is not known.
        within = difference.value <= difference.standard_error or difference.value <= difference.rounding
        return setting == best or within

    def compare(self, setting: Setting, chosen: Setting) -> str:
        """Return the run time and the error of a setting, and its difference from the chosen setting, as text."""
        difference = self.worse(chosen, setting)
        value = self.measure.sign * difference.value
        error = (
            f" ± {significant(difference.standard_error, 2)}"
            if math.isfinite(difference.standard_error)
            else ""
        )
        return (
            f"{significant(self.milliseconds[setting], 3)} ms with {self.measure.key} {self.errors(setting).text()} "
            f"(paired difference of the new setting: {significant(value, 2, sign=True)}{error})"
        )

    def score(self, setting: Setting) -> float:
        """Return the error of a setting with the sign that makes lower values better; infinity if the error is NaN."""
        value = self.measure.sign * self.errors(setting).value
        return math.inf if math.isnan(value) else value

    def by_time(self) -> list[Setting]:
        """Return all settings, the fastest first."""
        return sorted(self.milliseconds, key=self.milliseconds.__getitem__)


def _within_time(bench: Bench, limit: float) -> tuple[Setting, str]:
    """Return the fastest of the settings with equally low errors within `limit` ms per sample, and the reason.

    Errors that exceed the lowest one by at most one standard error count as equally low (`Bench.equals`).
    """
    fastest = bench.by_time()[0]
    fitting = [setting for setting in bench.by_time() if bench.milliseconds[setting] <= limit] or [fastest]
    for setting in track_progress(fitting, "measuring errors", len(fitting), "settings"):
        bench.errors(setting)
    while fitting:
        best = min(fitting, key=bench.score)
        chosen = next(setting for setting in fitting if bench.equals(setting, best))
        if bench.time_again(chosen) <= limit:
            text = f"the best of {len(fitting)} settings within budget.milliseconds={limit:g}"
            if chosen == best:
                return chosen, f"it is {text}"
            return chosen, (
                f"it is the cheapest that is within one standard error of {bench.knobs.text(best)}, {text}"
            )
        fitting = fitting[: fitting.index(chosen)]
    names = ", ".join(bench.knobs.names)
    raise ConfigError(
        f"budget.milliseconds = {limit:g}: no setting of {names} is so fast on this machine. The nearest is "
        f"{bench.knobs.text(fastest)}, with {significant(bench.milliseconds[fastest], 3)} ms per sample in batches of "
        f"{len(bench.timed['input'])} and {bench.measure.key} {bench.errors(fastest).text()}. Raise the budget, or "
        "choose a faster model."
    )


def _within_error(bench: Bench, limit: float) -> tuple[Setting, str]:
    """Return the fastest setting whose error is within `limit`, also with other random numbers, and the reason."""
    order, key = bench.by_time(), bench.measure.key
    sign, side = bench.measure.sign, "at most" if bench.measure.sign > 0 else "at least"
    for setting in track_progress(order, "measuring errors", len(order), "settings"):
        fresh = sign * bench.errors(setting, 1).value if bench.score(setting) <= sign * limit else math.nan
        if fresh <= sign * limit:
            bench.time_again(setting)
            return (
                setting,
                f"it is the cheapest of {len(order)} with {key} {side} {limit:g}, also with other draws",
            )
    nearest, names = min(order, key=bench.score), ", ".join(bench.knobs.names)
    raise ConfigError(
        f"budget.error = {limit:g}: no setting of {names} reaches {key} {side} {limit:g} on the validation samples. "
        f"The nearest is {bench.knobs.text(nearest)}, with {key} {bench.errors(nearest).text()} in "
        f"{significant(bench.milliseconds[nearest], 3)} ms per sample. Allow a larger error, or choose a better model."
    )
