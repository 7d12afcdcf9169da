"""Checks of the calibration of an uncertainty wrapper: it does no harm, and it uses all data that it is given."""

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
from framework.testing.rows import WrapperRow
from framework.testing.wrappers import Build, in_units, inputs, wrapped
from framework.uncertainty import Uncertainty

SPREADS = {"as sure as it should be": 1.0, "too sure": 3.0, "not sure enough": 0.3}
"""Description of a model → factor by which labels lie farther from the mode than draws of the model's densities."""
ROWS = 200
UNEVEN = ((50, 0.5), (50, 2.0), (30, 1.0), (4, 8.0))
"""Number of rows of each batch, and the factor that spreads its labels (see SPREADS)."""
FAR = 8.0
"""Factor on the usual inputs, so that models of different weights predict places far apart."""


@dataclass(frozen=True)
class Calibration:
    """Checks of one wrapper's calibration.

    Attributes:
        row: Row of the contract.
        build: Function that builds the row's wrapper for the row's target in any unit.
    """

    row: WrapperRow
    build: Build

    def checks(self) -> Iterator[tuple[str, float, Callable[[Worst], None]]]:
        """Yield the name, the limit and the function of each check."""
        yield "calibration does not harm", 4.0, self.no_harm
        yield "fits on all it is given", 0.05, self.on_all
        yield "what is wrapped is calibrated first", 0.0, self.wrapped_first

    @cached_property
    def target(self) -> Target:
        """Target in another unit than the row's where it has one; no code may assume labels of size 1."""
        return in_units(self.row.target)[:2][-1]

    def make(self, target: Target | None = None) -> Uncertainty:
        """Return a new wrapper in float64 around models that are marked as calibrated."""
        seed(SEED)
        wrapper = self.build(target or self.target).eval().double()
        for model in wrapped(wrapper):
            model.calibrated.fill_(1)
        return wrapper

    def labelled(self, target: Target, count: int, spread: float, number: int) -> Batch:
        """Return seeded inputs, and labels drawn from the densities that the uncalibrated wrapper predicts.

        Args:
            target: Target of the wrapper.
            count: Number of rows.
            spread: Factor by which labels lie farther from the mode than draws.
            number: Number of the seed.
        """
        given = inputs(count, number).double()
        with torch.no_grad():
            density = self.make(target)(given)
            seed(SEED + number)
            return {"input": given, "target": spread_out(density, spread), "index": torch.arange(count)}

    @cached_property
    def densities(self) -> dict[str, Distribution]:
        """Densities, float64, by description, of three rows on which models differ much.

        The first entry holds the densities of the wrapper as built; each further entry holds those of the calibrated
        wrapper in one unit of the target.
        """
        found: dict[str, Distribution] = {}
        for number, target in enumerate(in_units(self.row.target)):
            where = f"location {target.location[0]:g}, scale {target.scale[0]:g}, " if target.scale else ""
            wrapper = self.make(target)
            with torch.no_grad():
                if number == 0:
                    found[f"{where}as built"] = wrapper(FAR * inputs(3).double())
                wrapper.calibrate([self.labelled(target, 100, 2.0, 3)])
                seed(SEED)
                found[f"{where}calibrated"] = wrapper(FAR * inputs(3).double())
        return found

    @cached_property
    def many(self) -> dict[str, Distribution]:
        """Densities of the wrapper as built, of 64 rows."""
        with torch.no_grad():
            return {"as built": self.make(self.row.target)(FAR * inputs(64).double())}

    def no_harm(self, worst: Worst) -> None:
        """Check that calibration does not lower the mean log-likelihood of validation rows and of new rows.

        The limit is 4 standard errors.
        """
        for what, spread in SPREADS.items():
            seen, unseen = (self.labelled(self.target, ROWS, spread, number) for number in (1, 2))
            wrapper = self.make()
            before = [log_prob(wrapper, batch) for batch in (seen, unseen)]
            wrapper.calibrate(in_batches(seen, 64))
            after = [log_prob(wrapper, batch) for batch in (seen, unseen)]
            for rows, first, then in zip(("validation", "new"), before, after, strict=True):
                loss = first - then
                noise = loss.std() / len(loss) ** 0.5 + 1e-3
                worst.see(
                    loss.mean() / noise,
                    f"{rows} rows of a model that is {what}: {first.mean().item():.4g} nats before, "
                    f"{then.mean().item():.4g} after",
                )

    def on_all(self, worst: Worst) -> None:
        """Check that batches in reverse order, as one batch, or given only once lead to the same densities.

        The error is the mean difference of log-densities, nats.
        """
        given = [self.labelled(self.target, rows, spread, 3 + at) for at, (rows, spread) in enumerate(UNEVEN)]
        whole = {name: torch.cat([batch[name] for batch in given]) for name in given[0]}
        backwards = [{name: field.flip(0) for name, field in batch.items()} for batch in given[::-1]]
        new = self.labelled(self.target, 50, 1.0, 9)
        wanted = self._fitted(given, new)
        ways: dict[str, Iterable[Batch]] = {
            "once": iter(given),
            "the other way round": backwards,
            "as one": [whole],
        }
        for what, batches in ways.items():
            found = self._fitted(batches, new)
            error = torch.where(found == wanted, 0.0, (found - wanted).abs()).mean()
            worst.see(error, f"batches that come {what}")

    def _fitted(self, batches: Iterable[Batch], new: Batch) -> Tensor:
        wrapper = self.make()
        seed(SEED)
        wrapper.calibrate(batches)
        return log_prob(wrapper, new)

    def wrapped_first(self, worst: Worst) -> None:
        """Check that `calibrate` first calibrates the wrapped models and then fits to their densities."""
        given = in_batches(self.labelled(self.target, 100, 2.0, 3), 30)
        found = []
        for before in (0, 1):
            wrapper = self.make()
            for model in wrapped(wrapper):
                model.calibrated.fill_(before)
            seed(SEED)
            wrapper.calibrate(given)
            for number, model in enumerate(wrapped(wrapper)):
                worst.count(model.calibrated != 1, f"model {number} is not calibrated")
            found.append(log_prob(wrapper, given[0]))
        worst.same_bits("log_prob, whatever is wrapped was calibrated before or not", *found)


def spread_out(density: Distribution, factor: float) -> Tensor:
    """Return one label for each row: a draw of the density, `factor` times as far from the mode.

    A label of classes is a draw from the probabilities p^(1/factor), normalised.
    """
    if density.has_enumerate_support:
        logits = density.log_prob(density.enumerate_support()).movedim(0, -1)
        return Categorical(logits=logits / factor).sample()
    drawn, mode = density.sample(), density.mode
    if isinstance(density.support, Circular):
        return wrap(mode + (factor * wrap(drawn - mode)).clamp(-3.1, 3.1))
    return mode + factor * (drawn - mode)


def in_batches(batch: Batch, rows: int) -> list[Batch]:
    """Split a batch into batches of at most `rows` rows."""
    parts = {name: field.split(rows) for name, field in batch.items()}
    return [{name: part[at] for name, part in parts.items()} for at in range(len(parts["target"]))]


@torch.no_grad()
def log_prob(wrapper: Uncertainty, batch: Batch) -> Tensor:
    """Return the log-density at the targets, (rows,) float64, with the same random numbers at each call."""
    seed(SEED)
    return wrapper(batch["input"]).log_prob(batch["target"]).double()
