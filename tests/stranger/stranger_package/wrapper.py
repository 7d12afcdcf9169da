"""An uncertainty wrapper that the framework does not ship."""

from collections.abc import Callable, Iterable
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.data import Batch
from framework.distributions.batch_shapes import Stacked
from framework.distributions.density import Mixture
from framework.model import Predictor
from framework.uncertainty import Uncertainty


class Committee(Uncertainty):
    """Wrapper of several copies, each trained on all data; it mixes their densities with equal weights."""

    bibtex = ""

    def __init__(self, model: Callable[[], Predictor], *, members: Annotated[int, Field(ge=1)] = 3) -> None:
        super().__init__()
        self.members = nn.ModuleList(model() for _ in range(members))

    def forward(self, inputs: Tensor) -> Distribution:
        densities = [member(inputs) for member in self.members]
        weights = torch.zeros(*densities[0].batch_shape, len(densities), device=inputs.device)
        return Mixture(weights, Stacked(densities))

    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        return torch.stack([member.loss(inputs, target) for member in self.members]).mean(0)

    def training_densities(self, inputs: Tensor) -> Distribution:
        return self(inputs)

    def calibrate(self, batches: Iterable[Batch]) -> None:
        kept = list(batches)
        for member in self.members:
            member.calibrate(kept)


class AveragedCommittee(Committee):
    """Wrapper that averages directions, which the contract forbids: with one member it does not return that member's
    density."""

    def forward(self, inputs: Tensor) -> Distribution:
        densities = [member(inputs) for member in self.members]
        places = torch.stack([density.location for density in densities])
        return type(densities[0])(torch.atan2(places.sin().mean(0), places.cos().mean(0)))

    def calibrate(self, batches: Iterable[Batch]) -> None:
        pass
