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
from plugins.encoder.flights.parabolas_compiled import fill_features

SPANS = (1.0, 0.7, 0.5, 0.35)
"""Shares of the observed frames to which parabolas are fitted; each span of frames ends with the last frame.

The longest span that a parabola fits is used. A span with a bounce is therefore not used.
"""
SPEED, GROWTH = (0.4, 0.4, 3.0), (0.5, 0.5, 6.0)
"""Growth of the unit of x, y and z with time, m/s, and with the square of time, m/s².

The unit of a coordinate is the length in which a density head expresses its distance from the parabola.

The values of z are larger, because a bounce reverses the velocity along z, and the last frames may hold a bounce.
"""
OTHER_FEATURES = 24
"""Number of features in addition to two for each predicted coordinate and seven for each observed frame."""


class ExtrapolationEncoder(Encoder):
    """Extrapolated positions of the ball on a robust parabola through its last frames.

    Features: x, y and z on the parabola at each future frame, m; the logarithms of the units in which a density head
    expresses how far the ball is from these positions; the coefficients of the parabolas through the longest span of
    frames that a parabola fits and through the shortest one, the index of the first of these spans, and logarithms of
    the variance of its parabola; and the observed frames, relative to the parabola.

    Each coordinate is a parabola in time. It is fitted to the last frames by least squares with Cauchy's weights, so
    that an outlier has little influence. Drag, spin, table and bounce are not modelled. Nothing is learnt.

    Args:
        future: number of future frames; the same value as in the config of the data.
        step: time from frame to frame, s; the same value as in the config of the data.
        noise: standard deviation of the measurement error of each coordinate, m.

    Raises:
        ConfigError: the inputs are not flattened frames with the numbers of `framework.flights.frames.PARTS`.
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
        frames = count_frames(input_shape, "encoder extrapolation")
        self.future, self.step, self.noise = future, step, noise
        self.output_shape = (6 * future + OTHER_FEATURES + 7 * frames,)

    @torch.no_grad()
    def forward(self, inputs: Tensor) -> Float[Tensor, "batch length"]:
        """Return the features of the flights."""
        dtype = inputs.dtype if inputs.is_floating_point() else torch.get_default_dtype()
        observed = observed_frames(inputs.double().unflatten(-1, (-1, len(PARTS))), self.step)
        observed = ObservedFrames(*(part.cpu() for part in observed))
        moments = self.step * np.arange(1, self.future + 1)
        spans = np.array([max(3, round(share * observed.times.shape[1])) for share in SPANS])
        features = torch.empty(len(inputs), *self.output_shape, dtype=torch.float64)
        fill_features(
            *(part.contiguous().numpy() for part in (observed.times, observed.places, observed.observed)),
            GRAVITY,
            spans,
            self.noise,
            np.array(SPEED),
            np.array(GROWTH),
            moments,
            features.numpy(),
        )
        return features.to(inputs.device, dtype)


def count_frames(input_shape: tuple[int, ...], by: str) -> int:
    """Return the number of observed frames in a sample.

    Args:
        input_shape: shape of a sample, (frames × numbers of `PARTS`,).
        by: name of the encoder, for messages.

    Raises:
        ConfigError: the shape is not that of flattened frames with the numbers of `PARTS`.
    """
    length = math.prod(input_shape)
    if len(input_shape) != 1 or length % len(PARTS) or not length:
        raise ConfigError(
            f"{by} got samples of shape {input_shape}, but flattened frames of {', '.join(PARTS)} are required. Set "
            "data=table_tennis."
        )
    return length // len(PARTS)
