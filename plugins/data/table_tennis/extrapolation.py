"""A flight's path without physics, as features: the parabola on which the last frames lie, and what is off it."""

import math
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.encoder import Encoder
from framework.errors import ConfigError
from plugins.data.table_tennis.estimation import Seen, seen_of
from plugins.data.table_tennis.parabolas_compiled import parabolas
from plugins.data.table_tennis.windows import GRAVITY, PARTS

SPANS = (1.0, 0.7, 0.5, 0.35)
"""Shares of the frames that a parabola is laid through: the longest that it fits counts, a bounce is left behind."""
GROWTH = (0.5, 0.5, 6.0)
"""By which the features' unit grows with the square of time, m/s²: z is reversed by a bounce."""
FURTHER = 24
"""Features beside the two of each number that is predicted and the four of each frame."""


class ExtrapolationEncoder(Encoder):
    """Where the ball would be if it went on as it did.

    Metres: x, y and z at each future frame, the logarithms of units in which to say how far it is from there, and what
    was seen, relative to it.

    Each coordinate is a parabola in time, laid through the last frames by least squares with Cauchy's weights, so that
    an outlier counts for little; no drag, spin, table or bounce is known. Nothing is learnt.

    Args:
        future, step: of the data.
        noise: of a coordinate, m.

    Raises:
        ConfigError: inputs are no frames of `PARTS`, flattened.
    """

    bibtex = """@article{holland1977robust,
  author  = {Holland, Paul W. and Welsch, Roy E.},
  title   = {Robust Regression Using Iteratively Reweighted Least-Squares},
  journal = {Communications in Statistics},
  volume  = {6},
  number  = {9},
  pages   = {813--827},
  year    = {1977}
}"""
    fixed = True

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        future: Annotated[int, Field(ge=1, le=1000)] = 35,
        step: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.016,
        noise: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.003,
    ) -> None:
        super().__init__()
        frames = frames_of(input_shape, "encoder extrapolation")
        self.future, self.step, self.noise = future, step, noise
        self.output_shape = (6 * future + FURTHER + 7 * frames,)

    @torch.no_grad()
    def forward(self, inputs: Tensor) -> Float[Tensor, "batch length"]:
        dtype = inputs.dtype if inputs.is_floating_point() else torch.get_default_dtype()
        seen = seen_of(inputs.double().unflatten(-1, (-1, len(PARTS))), self.step)
        there = seen.there.unsqueeze(-1)
        long, short, spread, span = self._parabolas(seen)
        moments = self.step * torch.arange(1, self.future + 1, dtype=torch.float64, device=inputs.device)
        powers = _powers(moments)
        mean = powers @ long
        mean[..., 2] -= GRAVITY / 2 * moments.square()
        deviation = torch.einsum("ti,bij,tj->bt", powers, spread, powers).clamp(min=0).sqrt()
        growth = torch.tensor(GROWTH, dtype=torch.float64, device=inputs.device)
        unit = self.noise + growth * moments.square().unsqueeze(-1)
        off = torch.where(there, _fallen(seen) - _powers(seen.times) @ long, 0.0)
        # both finely and coarsely: a bounce's path is metres from the parabola, a frame's noise millimetres
        features = [
            mean.clamp(-100, 100), unit.log().expand_as(mean), long / 5, short / 5,
            span, deviation[:, [0, -1]].unsqueeze(-1).log() / 3,
            torch.tanh(off / (2 * self.noise)), torch.tanh(off / 0.1), there,
        ]  # fmt: skip
        return torch.cat([part.flatten(1).double() for part in features], 1).clamp(-1e4, 1e4).to(dtype)

    def _parabolas(self, seen: Seen) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The coefficients (flight, 3, axis) of the longest span that fits, and of the shortest; the covariance of an
        axis's (flight, 3, 3); and which span it is (flight, span), one-hot. Computed on the processor."""
        device, (flights, frames) = seen.times.device, seen.times.shape
        spans = np.array([max(3, round(share * frames)) for share in SPANS])
        long, short, spread = (torch.empty(flights, 3, 3, dtype=torch.float64) for _ in range(3))
        span = torch.empty(flights, dtype=torch.int64)
        given = (part.contiguous().cpu().numpy() for part in (seen.times, _fallen(seen), seen.there))
        parabolas(*given, spans, self.noise, *(part.numpy() for part in (long, short, spread, span)))
        one_hot = torch.nn.functional.one_hot(span, len(SPANS))
        return long.to(device), short.to(device), spread.to(device), one_hot.to(device)


def frames_of(input_shape: tuple[int, ...], by: str) -> int:
    """How many frames a sample has.

    Raises:
        ConfigError: it is no sample of frames.
    """
    length = math.prod(input_shape)
    if len(input_shape) != 1 or length % len(PARTS) or not length:
        raise ConfigError(
            f"{by} got samples of shape {input_shape}; wanted frames of {', '.join(PARTS)}, flattened. Choose "
            "data=table_tennis."
        )
    return length // len(PARTS)


def _powers(times: Float[Tensor, "*batch time"]) -> Float[Tensor, "*batch time 3"]:
    return torch.stack([torch.ones_like(times), times, times.square() / 2], -1)


def _fallen(seen: Seen) -> Float[Tensor, "flight frame 3"]:
    """Places as they would be without gravity."""
    fall = torch.tensor([0.0, 0.0, GRAVITY / 2], dtype=torch.float64, device=seen.places.device)
    return seen.places + fall * seen.times.square().unsqueeze(-1)
