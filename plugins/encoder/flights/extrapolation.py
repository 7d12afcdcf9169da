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
from framework.flights.estimation import Seen, seen_of
from framework.flights.frames import GRAVITY, PARTS
from plugins.encoder.flights.parabolas_compiled import described

SPANS = (1.0, 0.7, 0.5, 0.35)
"""Shares of the frames that a parabola is laid through: the longest that it fits counts, a bounce is left behind."""
SPEED, GROWTH = (0.4, 0.4, 3.0), (0.5, 0.5, 6.0)
"""By which the unit of features grows with time, m/s, and its square, m/s²: z is reversed by a bounce, which may have
been in the last frames."""
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
        seen = Seen(*(part.cpu() for part in seen))
        moments = self.step * np.arange(1, self.future + 1)
        spans = np.array([max(3, round(share * seen.times.shape[1])) for share in SPANS])
        features = torch.empty(len(inputs), *self.output_shape, dtype=torch.float64)
        described(
            *(part.contiguous().numpy() for part in (seen.times, seen.places, seen.there)),
            GRAVITY,
            spans,
            self.noise,
            np.array(SPEED),
            np.array(GROWTH),
            moments,
            features.numpy(),
        )
        return features.to(inputs.device, dtype)


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
