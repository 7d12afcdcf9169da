"""A density around a mean that an encoder computes, for example by physics; a network predicts the density's shape."""

from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.density_head import DensityHead
from framework.distributions.affine import AffineDensity
from framework.heads.parameters import require_finite, require_trained
from framework.heads.unit import Unit
from framework.target import Target

LARGEST = 1e4
"""Largest magnitude of the features; larger ones are clamped."""
LARGEST_LOG_UNIT = 20.0


class HybridHead(DensityHead):
    """A learned density around a mean that the encoder gives, such as the prediction of a physical model.

    The features that the head reads begin with the mean, in the target's unit and order. Then follows one number for
    each number of the target: the logarithm of the unit in which the component describes the distance of the target
    from the mean. A network of two hidden layers reads all features and predicts the raw parameters of the component.
    Unless the component has trained parameters of its own, the last layer of the network starts at 0, so that at first
    the mean of the density is the encoder's mean.

    Args:
        further: number of the encoder's features that follow the mean and the logarithms of the units.
        hidden: width of the network.
        share: factor by which the encoder's units are multiplied to give the units of the component.
        component: the head whose density is shifted and scaled.
    """

    direct = True
    bibtex = "psichogios1992hybrid"

    def __init__(
        self,
        target: Target,
        *,
        further: Annotated[int, Field(ge=0)] = 100,
        hidden: Annotated[int, Field(ge=1)] = 256,
        share: Annotated[float, Field(gt=0, le=10)] = 1.0,
        component: DensityHead = {"name": "gaussian"},  # noqa: B006  # pyright: ignore[reportArgumentType]
    ) -> None:
        super().__init__()
        target.require("real", by="density_head hybrid")
        self.numbers = len(target.names)
        self.unit = Unit.of(target)
        self.share = share
        self.component = require_trained(component)
        self.size = 2 * self.numbers + further
        last = nn.Linear(hidden, component.size)
        if not any(True for _ in component.parameters()):
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)
        self.network = nn.Sequential(
            nn.Linear(self.size, hidden), nn.SiLU(), nn.Linear(hidden, hidden), nn.SiLU(), last
        )

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Distribution:
        """Return the density for raw parameters."""
        numbers, location, scale = self._read(raw)
        return AffineDensity(self.component(numbers), location, scale)

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        """Return the component's loss for (target - location) / scale, plus Σ log scale, nats (change of variables).

        Location and scale are those of the affine transform that maps the component's density to the head's density.
        """
        numbers, location, scale = self._read(raw)
        return self.component.loss(numbers, (target - location) / scale) + scale.log().sum(-1)

    def _read(self, raw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the component's raw parameters, and the location and scale of the affine transform of its density.

        Location and scale are (*batch, number). The head returns the density of location + scale · x, where x has the
        component's density.
        """
        raw = require_finite(raw, self.size)
        weight = self.network[-1].weight
        assert isinstance(weight, Tensor)
        cut = raw.clamp(-LARGEST, LARGEST)
        mean, log_unit, _ = cut.split([self.numbers, self.numbers, self.size - 2 * self.numbers], -1)
        read = torch.cat([self.unit.standardise(mean).to(cut), cut[..., self.numbers :]], -1)
        numbers = self.network(read.to(weight.dtype))
        scale = self.share * log_unit.clamp(-LARGEST_LOG_UNIT, LARGEST_LOG_UNIT).exp()
        location, spread = self.unit.location, self.unit.scale
        if location is None or spread is None:
            return numbers, mean, scale
        # the component's density is relative to the targets' mean and in units of their standard deviations
        scale = (scale / spread.to(mean.device)).to(mean)
        return numbers, mean - scale * location.to(mean), scale
