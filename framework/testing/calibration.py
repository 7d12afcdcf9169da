"""Checks of the calibration of an uncertainty wrapper: no loss of likelihood, and use of all validation data.

Each check records its errors in `worst` (`framework.testing.finding.Worst`), which keeps the largest one.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.distributions import Categorical, Distribution

from framework.data import Batch
from framework.distributions.circular import Circular, wrap
from framework.target import Target
from framework.testing.finding import SEED, Worst, seed
from framework.testing.plain import Build, in_units, inputs, wrapped_models
from framework.testing.rows import WrapperRow
from framework.uncertainty import Uncertainty

SPREADS = {"calibrated": 1.0, "overconfident": 3.0, "underconfident": 0.3}
"""Kind of model → factor by which targets lie farther from the mode than draws from the model's densities."""
ROWS = 200
"""Number of samples of the validation data and of the new data."""
UNEVEN = ((50, 0.5), (50, 2.0), (30, 1.0), (4, 8.0))
"""Number of samples of each batch, and factor on the distances of its targets from the mode (as in SPREADS)."""
FAR = 8.0
"""Factor on the inputs, so that models with different weights predict locations far from each other."""


@dataclass(frozen=True)
class Calibration:
    """Checks of one wrapper's calibration.

    Attributes:
        row: Contract row of the wrapper.
        build: Function that builds the wrapper for the row's target in any unit.
    """

    row: WrapperRow
    build: Build

    def checks(self) -> Iterator[tuple[str, float, Callable[[Worst], None]]]:
        """Yield the name, the limit (largest error that passes) and the function of each check."""
        yield "calibration does not harm", 4.0, self.no_harm
        yield "calibration uses every row", 0.05, self.use_of_all_rows
        yield "wrapped models are calibrated first", 0.0, self.wrapped_first

    @cached_property
    def target(self) -> Target:
        """Target of the contract row; a real-valued target is converted to another unit, with values far from 0."""
        return in_units(self.row.target)[:2][-1]

    def make(self, target: Target | None = None) -> Uncertainty:
        """Return a new wrapper, in float64 and evaluation mode, around models that are marked as calibrated."""
        seed(SEED)
        wrapper = self.build(target or self.target).eval().double()
        for model in wrapped_models(wrapper):
            model.calibrated.fill_(1)
        return wrapper

    def draw_batch(self, target: Target, count: int, spread: float, number: int) -> Batch:
        """Return a batch of seeded inputs, with targets around the densities that the uncalibrated wrapper predicts.

        Args:
            target: Target of the wrapper.
            count: Number of samples.
            spread: Factor by which targets lie farther from the mode than draws from the densities do.
            number: Number that selects the seed.
        """
        batch_inputs = inputs(count, number).double()
        with torch.no_grad():
            density = self.make(target)(batch_inputs)
            seed(SEED + number)
            return {
                "input": batch_inputs,
                "target": draw_spread(density, spread),
                "index": torch.arange(count),
            }

    @cached_property
    def densities(self) -> dict[str, Distribution]:
        """Description → densities, float64, of three inputs at which models with different weights differ much.

        The first entry is the wrapper as built. Each further entry is the calibrated wrapper in one unit of the target.
        """
        densities: dict[str, Distribution] = {}
        for number, target in enumerate(in_units(self.row.target)):
            where = f"location {target.location[0]:g}, scale {target.scale[0]:g}, " if target.scale else ""
            wrapper = self.make(target)
            with torch.no_grad():
                if number == 0:
                    densities[f"{where}as built"] = wrapper(FAR * inputs(3).double())
                wrapper.calibrate([self.draw_batch(target, 100, 2.0, 3)])
                seed(SEED)
                densities[f"{where}calibrated"] = wrapper(FAR * inputs(3).double())
        return densities

    @cached_property
    def many(self) -> dict[str, Distribution]:
        """Description → densities of the wrapper as built, for 64 inputs."""
        with torch.no_grad():
            return {"as built": self.make(self.row.target)(FAR * inputs(64).double())}

    def no_harm(self, worst: Worst) -> None:
        """Check that calibration does not lower the mean log-likelihood of the validation samples or of new samples.

        The error is the mean decrease, divided by the sum of its standard error and 1e-3 nats.
        """
        for confidence, spread in SPREADS.items():
            validation, fresh = (self.draw_batch(self.target, ROWS, spread, number) for number in (1, 2))
            wrapper = self.make()
            before = [log_prob(wrapper, batch) for batch in (validation, fresh)]
            wrapper.calibrate(split_batch(validation, 64))
            after = [log_prob(wrapper, batch) for batch in (validation, fresh)]
            for rows, first, then in zip(("validation", "new"), before, after, strict=True):
                loss = first - then
                noise = loss.std() / len(loss) ** 0.5 + 1e-3
                worst.record(
                    loss.mean() / noise,
                    f"{rows} rows, {confidence} model: {first.mean().item():.4g} nats before calibration, "
                    f"{then.mean().item():.4g} after",
                )

    def use_of_all_rows(self, worst: Worst) -> None:
        """Check that the calibrated densities do not depend on how the validation samples are passed.

        The samples are passed in batches, in batches in reverse order, as one batch, and by an iterator that can be
        read only once. The error is the mean difference of log-densities, nats.
        """
        uneven = [
            self.draw_batch(self.target, rows, spread, 3 + at) for at, (rows, spread) in enumerate(UNEVEN)
        ]
        whole = {name: torch.cat([batch[name] for batch in uneven]) for name in uneven[0]}
        backwards = [{name: field.flip(0) for name, field in batch.items()} for batch in uneven[::-1]]
        new = self.draw_batch(self.target, 50, 1.0, 9)
        expected = self._calibrated_log_prob(uneven, new)
        variants: dict[str, Iterable[Batch]] = {
            "batches from an iterator that can be read once": iter(uneven),
            "batches in reverse order": backwards,
            "all rows in one batch": [whole],
        }
        for variant, batches in variants.items():
            actual = self._calibrated_log_prob(batches, new)
            error = torch.where(actual == expected, 0.0, (actual - expected).abs()).mean()
            worst.record(error, variant)

    def _calibrated_log_prob(self, batches: Iterable[Batch], new: Batch) -> Tensor:
        wrapper = self.make()
        seed(SEED)
        wrapper.calibrate(batches)
        return log_prob(wrapper, new)

    def wrapped_first(self, worst: Worst) -> None:
        """Check that `calibrate` first calibrates the wrapped models, and then fits the wrapper to their densities."""
        batches = split_batch(self.draw_batch(self.target, 100, 2.0, 3), 30)
        log_probs = []
        for before in (0, 1):
            wrapper = self.make()
            for model in wrapped_models(wrapper):
                model.calibrated.fill_(before)
            seed(SEED)
            wrapper.calibrate(batches)
            for number, model in enumerate(wrapped_models(wrapper)):
                worst.count(model.calibrated != 1, f"wrapped model {number} is not calibrated")
            log_probs.append(log_prob(wrapper, batches[0]))
        worst.same_bits("log_prob, whether or not the wrapped models were calibrated before", *log_probs)


def draw_spread(density: Distribution, factor: float) -> Tensor:
    """Return one target for each item of the batch: a draw from the density, moved away from the mode.

    The distance of the draw from the mode is multiplied by `factor`; for angles it is at most 3.1 radians afterwards.
    For classes the target is a draw from the probabilities p^(1/factor), normalised.
    """
    if density.has_enumerate_support:
        logits = density.log_prob(density.enumerate_support()).movedim(0, -1)
        return Categorical(logits=logits / factor).sample()
    draw, mode = density.sample(), density.mode
    if isinstance(density.support, Circular):
        return wrap(mode + (factor * wrap(draw - mode)).clamp(-3.1, 3.1))
    return mode + factor * (draw - mode)


def split_batch(batch: Batch, rows: int) -> list[Batch]:
    """Split a batch into batches of at most `rows` samples."""
    parts = {name: field.split(rows) for name, field in batch.items()}
    return [{name: part[at] for name, part in parts.items()} for at in range(len(parts["target"]))]


@torch.no_grad()
def log_prob(wrapper: Uncertainty, batch: Batch) -> Tensor:
    """Return the log-density at a batch's targets, (samples,) float64, with the same random numbers at each call."""
    seed(SEED)
    return wrapper(batch["input"]).log_prob(batch["target"]).double()
