"""Search space: the domains of sweeps in Hydra's grammar, and the overrides of its points."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from hydra.core.override_parser.types import ChoiceSweep, IntervalSweep, Override, RangeSweep

from framework.errors import ConfigError, did_you_mean

WHOLE = re.compile(r"[+-]?\d+(_\d+)*")
NARROWEST = 1e-12
"""Smallest width of an interval, divided by its larger end; a narrower interval contains too few distinct floats."""


@dataclass(frozen=True)
class Choice:
    """Domain of a key that is a list of equally likely values; `options` holds them in the notation of overrides."""

    options: Sequence[object]

    @property
    def size(self) -> float:
        """Number of different values."""
        return len(self.options) if isinstance(self.options, range) else len(set(self.options))

    def at(self, quantile: float) -> str:
        """Return the value at a quantile in [0, 1), written as in an override."""
        return str(self.options[min(int(quantile * len(self.options)), len(self.options) - 1)])


@dataclass(frozen=True)
class Interval:
    """Domain of a key that is an interval, start <= value < end.

    The value or, if `logarithmic` is True, its logarithm is uniform. If `whole` is True, the value is rounded down.
    """

    start: float
    end: float
    logarithmic: bool
    whole: bool

    @property
    def size(self) -> float:
        """Number of values; infinite for real numbers."""
        return self.end - self.start if self.whole else math.inf

    def at(self, quantile: float) -> str:
        """Return the value at a quantile in [0, 1), written as in an override."""
        if self.logarithmic:
            least, most = math.log(self.start), math.log(self.end)
            value = math.exp(least + quantile * (most - least))
        else:
            value = self.start + quantile * (self.end - self.start)
        return self.text(value)

    def text(self, value: float) -> str:
        """Return a value, moved into the interval if necessary, as it is written in an override."""
        if self.whole:
            return str(min(max(math.floor(value), int(self.start)), int(self.end) - 1))
        value = min(max(value, self.start), math.nextafter(self.end, self.start))
        return repr(_round_short(value, self.start, self.end))


Domain = Choice | Interval


def parse_space(overrides: Sequence[Override]) -> dict[str, Domain]:
    """Return the domain of each override, by the override's key including its prefix, such as "+".

    A fixed override is a choice of one value. The last override of a key counts, as in Hydra's own sweeper.

    Raises:
        ConfigError: no override is a sweep, or a sweep has no value.
    """
    domains: dict[str, Domain] = {}
    for override in overrides:
        for earlier in [key for key in domains if key.lstrip("+~") == _name(override)]:
            del domains[earlier]
        domains[override.get_key_element()] = _domain(override)
    if not any(override.is_sweep_override() for override in overrides):
        raise ConfigError(
            "The search has no search space, because no override is a sweep. Add a sweep, such as "
            "seed=0,1,2, 'density_head.latent=range(1,9)' or "
            "'optimizer.learning_rate=tag(log,interval(1e-4,1e-2))'."
        )
    return domains


def overrides_of(values: Mapping[str, str]) -> list[str]:
    """Return the overrides of a point of the search space, given the text of each value by its key."""
    return [key if key.startswith("~") and not value else f"{key}={value}" for key, value in values.items()]


def extremes(space: Mapping[str, Domain]) -> list[list[str]]:
    """Return the overrides of a few points of the search space, whose configs show whether all values are valid.

    At the first point every key has its first value. Every further point differs from the first point in one key. For a
    list of values there is one further point for each other value; for an interval or a range of numbers there is one,
    with the last value.
    """
    first = {key: domain.at(0.0) for key, domain in space.items()}
    points = [first]
    for key, domain in space.items():
        last = 1 - 1e-6 if domain.size == math.inf else math.nextafter(1.0, 0.0)
        values: Iterable[str] = [domain.at(last)]
        if isinstance(domain, Choice) and not isinstance(domain.options, range):
            values = map(str, domain.options)
        points += [{**first, key: value} for value in values if value != first[key]]
    return [overrides_of(point) for point in points]


def _name(override: Override) -> str:
    return override.get_key_element().lstrip("+~")


def _domain(override: Override) -> Domain:
    value = override.value()
    if not override.is_sweep_override():
        deleted = override.is_delete() and value is None
        return Choice([""] if deleted else [override.get_value_element_as_str()])
    if isinstance(value, IntervalSweep):
        return _interval(override, value)
    if isinstance(value, ChoiceSweep | RangeSweep):
        if value.tags:
            raise _error(
                override,
                f"The tag {', '.join(sorted(value.tags))} is allowed on intervals only. Leave the tag out.",
            )
        value.shuffle = (
            False  # Hydra would shuffle differently each time, and the values are drawn at random anyway
        )
    if isinstance(value, RangeSweep):
        if value.step == 0:
            raise _error(override, "The step of the range is 0. Give another step.")
        if isinstance(numbers := value.range(), range):
            options: Sequence[object] = numbers
        else:
            options = list(override.sweep_string_iterator())
    else:
        options = list(override.sweep_string_iterator())
    if not options:
        raise _error(override, "The sweep has no value. Give at least one.")
    return Choice(options)


def _interval(override: Override, sweep: IntervalSweep) -> Interval:
    if unknown := sorted(sweep.tags - {"log"}):
        raise _error(
            override,
            f"The only tag of an interval is log, but {unknown[0]} was given.{did_you_mean(unknown[0], ['log'])}",
        )
    start, end = sweep.start, sweep.end
    assert start is not None
    assert end is not None
    if not (math.isfinite(start) and math.isfinite(end)):
        raise _error(override, "Both ends of the interval must be finite. Give two finite numbers.")
    if end - start <= NARROWEST * max(abs(start), abs(end)):
        raise _error(
            override,
            "The smaller end must come first, then a larger one (start <= value < end). Correct the ends.",
        )
    logarithmic = "log" in sweep.tags
    if logarithmic and start <= 0:
        raise _error(
            override, f"The start {start:g} has no logarithm. Start above 0, or leave tag(log, ...) out."
        )
    whole = _whole(override, sweep)
    if whole and end - start == 1:
        raise _error(
            override,
            f"The only whole number in the interval is {start:.0f}. Write interval({start:.1f},{end:.1f}) for real "
            "numbers.",
        )
    return Interval(start, end, logarithmic, whole)


def _whole(override: Override, sweep: IntervalSweep) -> bool:
    """Return whether both ends are written as whole numbers, or cast to them, since Hydra's parser returns floats."""
    if isinstance(sweep.start, int) and isinstance(sweep.end, int):  # int(interval(...))
        return True
    text = override.get_value_string()
    ends = re.search(r"interval\(([^()]*)\)", text)
    if ends is None or re.search(r"\bfloat\s*\(", text):
        return False
    return all(WHOLE.fullmatch(end.rpartition("=")[2].strip()) for end in ends[1].split(","))


def _round_short(value: float, start: float, end: float) -> float:
    """Return the number rounded to as few digits as possible within 1e-6 of the interval's width, for tables."""
    rounded = (float(f"{value:.{digits}g}") for digits in range(6, 18))
    return next(
        number for number in rounded if start <= number < end and abs(number - value) <= 1e-6 * (end - start)
    )


def _error(override: Override, message: str) -> ConfigError:
    return ConfigError(f"{override.input_line}: {message}")
