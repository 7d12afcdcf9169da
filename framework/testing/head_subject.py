"""A density head under test, with seeded raw parameters and targets for it."""

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.density_head import DensityHead, Fitted
from framework.target import Target
from framework.testing.finding import SEED, Finding, Worst, run_check, seed
from framework.testing.rows import HeadRow

TIME_LIMIT = 20.0
"""Limit of processor time for one check, seconds."""


@dataclass
class HeadSubject:
    """Contract row of a density head, with the function that builds the head.

    Attributes:
        row: Contract row of the head.
        build: Function that builds the head for the row's target; the random seed determines its parameters.
        seconds: Limit of processor time for a check, seconds; it is 1 s after a check has exceeded it.
        build_for: Function that builds the head for another target; None to leave out the check of the target's unit.
        only: Name of the only property to check; "" for all.
    """

    row: HeadRow
    build: Callable[[], DensityHead]
    seconds: float = TIME_LIMIT
    build_for: Callable[[Target], DensityHead] | None = None
    only: str = ""
    _fitted: tuple[DensityHead, Tensor] | None = field(default=None, init=False, repr=False)
    """Head that `make` copies, and the state of the random generator after its fit; None before the first."""

    def run_check(self, name: str, limit: float, check: Callable[[Worst], None]) -> Finding:
        """Run one check, with the row's limit if it has one for the property, and return the finding."""
        finding = run_check(name, self.row.limits.get(name, limit), check, seconds=self.seconds)
        if finding.worst.startswith("TooSlow"):
            self.seconds = 1.0
        return finding

    def includes(self, name: str) -> bool:
        """Return whether a property is to be checked."""
        return name not in self.row.leave_out and self.only in ("", name)

    def build_anew(self) -> DensityHead:
        """Build a head in evaluation mode, and fit it if it is a `Fitted` head."""
        seed(SEED)
        return self.build().eval()

    def make(self) -> DensityHead:
        """Return a new head in evaluation mode.

        `Fitted` heads are copies of the first one, since fitting would take most of the time of the checks.
        """
        if self._fitted is None:
            head = self.build_anew()
            if not isinstance(head, Fitted):
                return head
            self._fitted = head, torch.default_generator.get_state()
        head, state = self._fitted
        torch.default_generator.set_state(state)
        return copy.deepcopy(head)

    @cached_property
    def raw_shape(self) -> tuple[int, ...]:
        """Shape of the raw parameters that the head reads for a sample."""
        with torch.random.fork_rng(devices=[]):
            return self.make().raw_shape

    def raw_parameters(self, *batch: int) -> Tensor:
        """Return seeded raw parameters with a standard normal distribution, (*batch, *raw_shape), float32."""
        generator = torch.Generator().manual_seed(SEED)
        return torch.randn(*batch, *self.raw_shape, generator=generator)

    def scaled_parameters(self, sizes: Sequence[float]) -> Tensor:
        """Return random raw parameters, multiplied by a factor of `sizes` for each sample, (sample, *raw_shape)."""
        factors = torch.tensor(sizes, dtype=torch.float64)
        return self.raw_parameters(len(sizes)).double() * factors.view(-1, *[1] * len(self.raw_shape))

    def values(self, *batch: int) -> Tensor:
        """Return seeded targets of the contract row, (*batch, *event)."""
        if self.row.values is None:
            return values(self.row.target, batch)
        targets = self.row.values(math.prod(batch))
        return targets.reshape(*batch, *self.row.target.event_shape)

    def draws(self) -> bool:
        """Return true if log_prob draws random numbers, that is, if it differs between seeds for the same inputs."""
        try:
            with torch.no_grad():
                head, raw, value = self.make(), self.raw_parameters(4), self.values(4)
                log_probs = []
                for number in (0, 1):
                    seed(number)
                    log_probs.append(head(raw).log_prob(value))
            return not torch.equal(*log_probs)
        except Exception:  # the checks find the error
            return False


def fit_if_needed(head: DensityHead, target: Target) -> DensityHead:
    """Return the head; if it is a `Fitted` head, fit it first to seeded features and targets.

    A head without a fixed number of features is fitted to four features.
    """
    if isinstance(head, Fitted):
        features = torch.randn(200, head.size or 4, generator=torch.Generator().manual_seed(SEED))
        head.fit(features, values(target, (200,)), SEED)
    return head


def values(target: Target, batch: tuple[int, ...]) -> Tensor:
    """Return seeded targets (*batch, *event): angles over several turns, classes, or real numbers.

    Real numbers have the location and scale of the target, or mean 0 and standard deviation 1 if it has none.
    """
    generator = torch.Generator().manual_seed(SEED + 1)
    if target.kind == "class":
        return torch.randint(len(target.names), batch, generator=generator)
    scale = 6.0 if target.kind == "angle" else 1.0
    targets = scale * torch.randn(*batch, *target.event_shape, generator=generator)
    if target.scale:
        targets = torch.tensor(target.location).double() + torch.tensor(target.scale).double() * targets
    return targets


def seeded(head: DensityHead, raw: Tensor) -> Distribution:
    """Return the density for raw parameters; if it draws random numbers, they are the same at each call."""
    seed(SEED)
    return head(raw)


def as_type(value: Tensor, dtype: torch.dtype) -> Tensor:
    """Convert a floating-point tensor to the dtype; return any other tensor unchanged."""
    return value.to(dtype) if value.is_floating_point() else value
