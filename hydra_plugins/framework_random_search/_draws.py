"""Domains of sweeps in Hydra's grammar, and reproducible draws from them."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256

from hydra.core.override_parser.types import ChoiceSweep, IntervalSweep, Override, RangeSweep

from framework.errors import ConfigError, did_you_mean

WHOLE = re.compile(r"[+-]?\d+(_\d+)*")
NARROWEST = 1e-12
"""Smallest width of an interval, as a share of its larger end; a narrower one holds too few distinct numbers."""


@dataclass(frozen=True)
class Choice:
    """Choice among values, each as it is written in an override; all are equally likely."""

    options: Sequence[object]

    @property
    def size(self) -> float:
        """Number of different values."""
        return len(self.options) if isinstance(self.options, range) else len(set(self.options))

    def at(self, quantile: float) -> str:
        """Return the value at a quantile in [0, 1), as it is written in an override."""
        return str(self.options[min(int(quantile * len(self.options)), len(self.options) - 1)])


@dataclass(frozen=True)
class Interval:
    """Interval start <= value < end; the value or its logarithm is uniform, and rounded down if it is to be whole."""

    start: float
    end: float
    logarithmic: bool
    whole: bool

    @property
    def size(self) -> float:
        """Number of values; infinite for real numbers."""
        return self.end - self.start if self.whole else math.inf

    def at(self, quantile: float) -> str:
        """Return the value at a quantile in [0, 1), as it is written in an override."""
        if self.logarithmic:
            least, most = math.log(self.start), math.log(self.end)
            value = math.exp(least + quantile * (most - least))
        else:
            value = self.start + quantile * (self.end - self.start)
        if self.whole:
            return str(min(max(math.floor(value), int(self.start)), int(self.end) - 1))
        value = min(max(value, self.start), math.nextafter(self.end, self.start))
        return repr(_short(value, self.start, self.end))


Domain = Choice | Interval


def space(overrides: Sequence[Override]) -> dict[str, Domain]:
    """Return the domain of each override, by its key with its prefix; a fixed override is a choice of one value.

    The last override of a key counts, as in Hydra's own sweeper.

    Raises:
        ConfigError: nothing is swept, or a sweep has nothing to draw from.
    """
    found: dict[str, Domain] = {}
    for override in overrides:
        for earlier in [key for key in found if key.lstrip("+~") == _name(override)]:
            del found[earlier]
        found[override.get_key_element()] = _domain(override)
    if not any(override.is_sweep_override() for override in overrides):
        raise ConfigError(
            "hydra/sweeper=random_search has nothing to search: no override is a sweep. Give one, such as "
            "seed=0,1,2, 'density_head.latent=range(1,9)' or "
            "'optimizer.learning_rate=tag(log,interval(1e-4,1e-2))'."
        )
    return found


def draw(space: Mapping[str, Domain], trials: int, seed: int) -> tuple[list[list[str]], int]:
    """Return the overrides of different trials, and how many draws repeated an earlier one.

    There are `trials` of them, or all of the space if it holds fewer. To run a whole space, draws continue until all of
    its points have occurred, so that its order begins with that of a shorter search.
    """
    wanted = min(trials, math.prod(domain.size for domain in space.values()))
    found: dict[tuple[str, ...], None] = {}
    number = 0
    while len(found) < wanted:
        values = (
            domain.at(quantile(seed, number, key.lstrip("+"))) if domain.size > 1 else domain.at(0.0)
            for key, domain in space.items()
        )
        found[tuple(_written(key, value) for key, value in zip(space, values, strict=True))] = None
        number += 1
    return [list(trial) for trial in found], number - len(found)


def quantile(seed: int, trial: int, key: str) -> float:
    """Return a number in [0, 1), uniform over any of its arguments, and the same on every machine."""
    digest = sha256(f"{seed}\0{trial}\0{key}".encode()).digest()
    return (int.from_bytes(digest[:8], "big") >> 11) * 2.0**-53  # the 53 bits a float can hold


def described(space: Mapping[str, Domain], found: int, trials: int, repeated: int) -> str:
    """Return one line that describes the search that is about to run."""
    keys = [key.lstrip("+") for key, domain in space.items() if domain.size > 1]
    line = f"random search over {', '.join(keys) or 'a single point'}: {found} trials"
    if found < trials:
        line += f", all there are ({trials} were asked for)"
    return line + (f"; {repeated} draws repeated an earlier trial and are not run again" if repeated else "")


def _name(override: Override) -> str:
    return override.get_key_element().lstrip("+~")


def _written(key: str, value: str) -> str:
    return key if key.startswith("~") and not value else f"{key}={value}"


def _domain(override: Override) -> Domain:
    value = override.value()
    if not override.is_sweep_override():
        deleted = override.is_delete() and value is None
        return Choice([""] if deleted else [override.get_value_element_as_str()])
    if isinstance(value, IntervalSweep):
        return _interval(override, value)
    if isinstance(value, ChoiceSweep | RangeSweep):
        if value.tags:
            raise _wrong(
                override, f"the tag {', '.join(sorted(value.tags))} means nothing on it. Leave the tag out."
            )
        value.shuffle = False  # Hydra would shuffle differently each time, and the draws are random already
    if isinstance(value, RangeSweep):
        if value.step == 0:
            raise _wrong(override, "its step is 0. Give another one.")
        if isinstance(numbers := value.range(), range):
            options: Sequence[object] = numbers
        else:
            options = list(override.sweep_string_iterator())
    else:
        options = list(override.sweep_string_iterator())
    if not options:
        raise _wrong(override, "there is nothing in it to draw. Give at least one value.")
    return Choice(options)


def _interval(override: Override, sweep: IntervalSweep) -> Interval:
    if unknown := sorted(sweep.tags - {"log"}):
        raise _wrong(
            override, f"an interval's only tag is log, not {unknown[0]}.{did_you_mean(unknown[0], ['log'])}"
        )
    start, end = sweep.start, sweep.end
    assert start is not None
    assert end is not None
    if not (math.isfinite(start) and math.isfinite(end)):
        raise _wrong(override, "wanted two finite ends.")
    if end - start <= NARROWEST * max(abs(start), abs(end)):
        raise _wrong(override, "wanted the smaller end first, then a larger one (start <= value < end).")
    logarithmic = "log" in sweep.tags
    if logarithmic and start <= 0:
        raise _wrong(override, f"{start:g} has no logarithm. Start above 0, or leave tag(log, ...) out.")
    whole = _whole(override, sweep)
    if whole and end - start == 1:
        raise _wrong(
            override,
            f"the only whole number in it is {start:.0f}. Write interval({start:.1f},{end:.1f}) for real numbers.",
        )
    return Interval(start, end, logarithmic, whole)


def _whole(override: Override, sweep: IntervalSweep) -> bool:
    """Return whether both ends are written as whole numbers, or cast to them; Hydra's parser has made them floats."""
    if isinstance(sweep.start, int) and isinstance(sweep.end, int):  # int(interval(...))
        return True
    text = override.get_value_string()
    ends = re.search(r"interval\(([^()]*)\)", text)
    if ends is None or re.search(r"\bfloat\s*\(", text):
        return False
    return all(WHOLE.fullmatch(end.rpartition("=")[2].strip()) for end in ends[1].split(","))


def _short(value: float, start: float, end: float) -> float:
    """Return the nearest number of few digits, for tables and files, within a millionth of the interval."""
    rounded = (float(f"{value:.{digits}g}") for digits in range(6, 18))
    return next(
        number for number in rounded if start <= number < end and abs(number - value) <= 1e-6 * (end - start)
    )


def _wrong(override: Override, what: str) -> ConfigError:
    return ConfigError(f"{override.input_line}: {what}")
