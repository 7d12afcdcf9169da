"""Several copies of a model, with equal weights."""

from collections.abc import Callable, Iterable, Sequence
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.data import Batch
from framework.distributions.batch_shapes import Stacked
from framework.distributions.density import Mixture
from framework.model import Predictor
from framework.uncertainty import Uncertainty


class Example(Uncertainty):
    """Wrapper of several copies of a model, all trained on the same batches; it mixes their densities equally.

    Args:
        model: function that builds a newly initialised copy.
        members: number of copies.
    """

    bibtex = ""

    def __init__(self, model: Callable[[], Predictor], *, members: Annotated[int, Field(ge=1)] = 3) -> None:
        super().__init__()
        self.members: Sequence[Predictor] = nn.ModuleList(model() for _ in range(members))  # type: ignore[assignment]

    def forward(self, inputs: Tensor) -> Distribution:
        """Return the mixture of the members' densities."""
        densities = [member(inputs) for member in self.members]
        weights = torch.zeros(*densities[0].batch_shape, len(densities), device=inputs.device)
        return Mixture(weights, Stacked(densities))

    def loss(self, inputs: Tensor, target: Tensor) -> Float[Tensor, "batch"]:
        """Return the mean of the members' losses."""
        return torch.stack([member.loss(inputs, target) for member in self.members]).mean(0)

    def training_densities(self, inputs: Tensor) -> Distribution:
        """Return the densities for a batch of inputs, with the gradients that an objective needs."""
        return self(inputs)

    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Calibrate each member."""
        kept = list(batches)
        for member in self.members:
            member.calibrate(kept)
