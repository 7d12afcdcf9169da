"""Features of a flight without physics: the parabola through the last frames, and the residuals from it."""

import math
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.encoder import Encoder
from framework.errors import ConfigError
from framework.flights.estimation import ObservedFrames, observed_frames
from framework.flights.frames import GRAVITY, PARTS
from plugins.encoder.flights.parabolas_compiled import described

SPANS = (1.0, 0.7, 0.5, 0.35)
"""Shares of the frames that a parabola is fitted to; the longest that fits is used, so that a bounce is left out."""
SPEED, GROWTH = (0.4, 0.4, 3.0), (0.5, 0.5, 6.0)
"""Growth of the unit of features with time, m/s, and with its square, m/s², for each axis.

The values of z are larger, since a bounce reverses its velocity, and one may have been in the last frames.
"""
FURTHER = 24
"""Number of features beside the two of each predicted number and those of each frame."""


class ExtrapolationEncoder(Encoder):
    """Extrapolated positions of the ball on a robust parabola through its last frames.

    Features, from metres: x, y and z at each future frame; the logarithms of the units in which a head says how far the
    ball is from there; and the observed frames, relative to the parabola.

    Each coordinate is a parabola in time, fitted to the last frames by least squares with Cauchy's weights, so that an
    outlier has little influence. Drag, spin, table and bounce are not modelled. Nothing is learnt.

    Args:
        future, step: as of the data.
        noise: standard deviation of a coordinate, m.

    Raises:
        ConfigError: inputs are no frames of `PARTS`, flattened.
    """

    bibtex = "holland1977robust"
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
        """Return the features of the flights."""
        dtype = inputs.dtype if inputs.is_floating_point() else torch.get_default_dtype()
        seen = observed_frames(inputs.double().unflatten(-1, (-1, len(PARTS))), self.step)
        seen = ObservedFrames(*(part.cpu() for part in seen))
        moments = self.step * np.arange(1, self.future + 1)
        spans = np.array([max(3, round(share * seen.times.shape[1])) for share in SPANS])
        features = torch.empty(len(inputs), *self.output_shape, dtype=torch.float64)
        described(
            *(part.contiguous().numpy() for part in (seen.times, seen.places, seen.observed)),
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
    """Return the number of frames of a sample.

    Raises:
        ConfigError: the shape is not that of a sample of frames.
    """
    length = math.prod(input_shape)
    if len(input_shape) != 1 or length % len(PARTS) or not length:
        raise ConfigError(
            f"{by} got samples of shape {input_shape}; wanted frames of {', '.join(PARTS)}, flattened. Choose "
            "data=table_tennis."
        )
    return length // len(PARTS)
