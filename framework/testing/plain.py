"""The model that is wrapped in the checks of uncertainty wrappers, and seeded inputs for it."""

from collections.abc import Callable, Iterable
from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.data import Batch
from framework.model import Predictor
from framework.target import Target
from framework.testing.finding import SEED
from framework.testing.metrics import place_size, simplest_density
from framework.uncertainty import Uncertainty

Build = Callable[[Target], Uncertainty]
"""Function that builds the contract row's wrapper around `Plain`, for the row's target in any unit."""
LENGTH = 6
"""Number of values of an input."""
UNITS = ((200.0, 50.0), (-3.0, 1e-3))
"""Locations and scales of real-valued targets in which wrappers are checked, in addition to location 0 and scale 1."""


class Plain(Predictor):
    """Model that is wrapped in checks: a linear layer that returns location and breadth for `simplest_density`.

    The effect of `calibrate` is the same for all samples. A wrapper that calibrates this model can therefore be
    compared with a wrapper around a model that was calibrated before.

    Attributes:
        calibrated: Buffer that is 1 after `calibrate`, else 0.
    """

    calibrated: Tensor

    def __init__(self, target: Target) -> None:
        super().__init__()
        self.target = target
        self.dropout = nn.Dropout(0.1)  # for wrappers that need a dropout layer
        self.layer = nn.Linear(LENGTH, place_size(target) + 1)
        self.register_buffer("calibrated", torch.zeros(()))

    def forward(self, inputs: Tensor) -> Distribution:
        numbers = self.layer(self.dropout(inputs))
        place, breadth = numbers[..., :-1], (1 + numbers[..., -1].sigmoid()) * (1 + self.calibrated / 2)
        if self.target.scale:
            location, scale = (
                torch.tensor(part).to(place) for part in (self.target.location, self.target.scale)
            )
            place, breadth = location + scale * place, scale[0] * breadth
        return simplest_density(self.target, place, breadth)

    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        return -self(inputs).log_prob(target)

    def training_densities(self, inputs: Tensor) -> Distribution:
        return self(inputs)

    def calibrate(self, batches: Iterable[Batch]) -> None:
        # an iterator that was read before yields no rows
        rows = sum(len(batch["target"]) for batch in batches)
        self.calibrated.fill_(float(rows > 0))


def wrapped_models(wrapper: Uncertainty) -> list[Plain]:
    """Return the models inside the wrapper; the list is empty if it stores their parameters in another form."""
    return [module for module in wrapper.modules() if isinstance(module, Plain)]


def in_units(target: Target) -> list[Target]:
    """Return the target; if it is real-valued, also the same target in other units."""
    if target.kind != "real":
        return [target]
    many = len(target.names)
    other_units = [replace(target, location=(at,) * many, scale=(scale,) * many) for at, scale in UNITS]
    return [target, *other_units]


def inputs(count: int, number: int = 0) -> Tensor:
    """Return seeded inputs (count, LENGTH); `number` selects the seed."""
    return torch.randn(count, LENGTH, generator=torch.Generator().manual_seed(SEED + 100 * number))
