"""Physics that a network corrects: an encoder that flies the ball, and a head about where it arrives."""

from collections.abc import Mapping
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.density_head import DensityHead
from framework.distributions.moved import Moved
from framework.encoder import Encoder
from framework.heads.parameters import require_finite, require_trained
from framework.heads.unit import Unit
from framework.target import Target
from plugins.data.table_tennis.ballistic import BallisticHead
from plugins.data.table_tennis.estimation import Prior, estimated, root, seen_of
from plugins.data.table_tennis.extrapolation import frames_of
from plugins.data.table_tennis.flying import flown_with_slopes
from plugins.data.table_tennis.physics import Constants
from plugins.data.table_tennis.windows import PARTS

LARGEST = 1e4
"""Features are cut off here."""
LARGEST_LOG_UNIT = 20.0


class BallisticEncoder(Encoder):
    """The flight by its differential equation as features.

    Metres: x, y and z at each future frame, the logarithms of their standard deviations, and what was read (frame by
    frame as `PARTS`).

    The constants are those of the config, or those that a run of `density_head=ballistic` found. Nothing is learnt.

    Args:
        future, step: of the data.
        spin: standard deviation believed of each component of the spin, rad/s.
        noise: of a coordinate, m.
        constants: of the ball and the table.

    Raises:
        ConfigError: inputs are no frames of `PARTS`, flattened.
    """

    bibtex = BallisticHead.bibtex
    fixed = True

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        future: Annotated[int, Field(ge=1, le=1000)] = 35,
        step: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.016,
        spin: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 60.0,
        noise: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.003,
        constants: Constants,
    ) -> None:
        super().__init__()
        length = len(PARTS) * frames_of(input_shape, "encoder ballistic")
        self.future, self.step, self.noise = future, step, noise
        self.prior = Prior(spin=spin)
        self.constants = constants
        self.output_shape = (6 * future + length,)

    @torch.no_grad()
    def forward(self, inputs: Tensor) -> Float[Tensor, "batch length"]:
        dtype = inputs.dtype if inputs.is_floating_point() else torch.get_default_dtype()
        frames = inputs.double().clamp(-LARGEST, LARGEST).cpu()
        seen = seen_of(frames.unflatten(-1, (-1, len(PARTS))), self.step)
        estimate = estimated(seen, self.constants, self.noise, self.prior)
        moments = self.step * torch.arange(1, self.future + 1, dtype=torch.float64)
        times = torch.cat([seen.times, moments.expand(len(frames), -1)], 1)
        places, slopes = flown_with_slopes(estimate.state, times, self.constants)
        spread = (slopes[:, -self.future :].flatten(1, 2) @ root(estimate.covariance)).square().sum(-1)
        spread = (spread + self.noise**2).log() / 2
        found = torch.cat([places[:, -self.future :].flatten(1), spread, frames], 1)
        return found.clamp(-LARGEST, LARGEST).to(inputs.device, dtype)


class HybridHead(DensityHead):
    """A learned density about a mean that the encoder gives: that of the physics, say.

    The first numbers that it reads are the mean, in the target's unit and order, and as many logarithms of units, in
    which the component says how far the target is from the mean. A network of two hidden layers over all that is read
    says what the component's density looks like. Its last layer begins at 0, unless the component has layers of its
    own behind it: at first the mean is the encoder's alone.

    Args:
        further: how many numbers the encoder gives beside the mean and the units.
        hidden: width of the network.
        share: of these units, the component's.
        component: the head whose density is moved.
    """

    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {}
    direct = True
    bibtex = """@article{psichogios1992hybrid,
  author  = {Psichogios, Dimitris C. and Ungar, Lyle H.},
  title   = {A Hybrid Neural Network-First Principles Approach to Process Modeling},
  journal = {AIChE Journal},
  volume  = {38},
  number  = {10},
  pages   = {1499--1511},
  year    = {1992}
}"""

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
        numbers, location, scale = self._read(raw)
        return Moved(self.component(numbers), location, scale)

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        """The component's, of the target where the component sees it, and the logarithm of the unit."""
        numbers, location, scale = self._read(raw)
        return self.component.loss(numbers, (target - location) / scale) + scale.log().sum(-1)

    def _read(self, raw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What the component reads; location and scale of its frame, (*batch, number) each."""
        raw = require_finite(raw, self.size)
        weight = self.network[-1].weight
        assert isinstance(weight, Tensor)
        cut = raw.clamp(-LARGEST, LARGEST)
        mean, log_unit, _ = cut.split([self.numbers, self.numbers, self.size - 2 * self.numbers], -1)
        read = torch.cat([self.unit.standardised(mean).to(cut), cut[..., self.numbers :]], -1)
        numbers = self.network(read.to(weight.dtype))
        scale = self.share * log_unit.clamp(-LARGEST_LOG_UNIT, LARGEST_LOG_UNIT).exp()
        location, spread = self.unit.location, self.unit.scale
        if location is None or spread is None:
            return numbers, mean, scale
        # the component's density is about the targets' mean and in their standard deviations
        scale = (scale / spread.to(mean.device)).to(mean)
        return numbers, mean - scale * location.to(mean), scale

    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        pass  # everything is trained
