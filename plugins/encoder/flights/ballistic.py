"""Features of a flight by physics: the predicted path of the differential equation, and its standard deviations."""

from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.encoder import Encoder
from framework.flights.estimation import Prior, covariance_root, estimate_states, observed_frames
from framework.flights.frames import PARTS
from framework.flights.physics import Constants
from framework.flights.trajectories import simulate_with_jacobian
from plugins.encoder.flights.extrapolation import count_frames

LARGEST = 1e4
"""Bound on the magnitude of inputs and features; larger ones are clamped."""


class BallisticEncoder(Encoder):
    """Predicted flight of the ball by its differential equation, as features.

    Features: x, y and z at each future frame, m; the logarithms of their standard deviations; and the observed frames,
    each with the numbers of `framework.flights.frames.PARTS`: time, x, y, z, and whether the ball was seen.

    The constants are those of the config, or those that a run of `density_head=ballistic` has fitted. Nothing is
    learnt.

    Args:
        future: number of future frames; the same value as in the config of the data.
        step: time from frame to frame, s; the same value as in the config of the data.
        spin: prior standard deviation of each component of the spin, rad/s.
        noise: standard deviation of the measurement error of each coordinate, m.
        constants: constants of the ball and the table.

    Raises:
        ConfigError: the inputs are not flattened frames with the numbers of `PARTS`.
    """

    bibtex = "mulling2011biomimetic"
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
        length = len(PARTS) * count_frames(input_shape, "encoder ballistic")
        self.future, self.step, self.noise = future, step, noise
        self.prior = Prior(spin=spin)
        self.constants = constants
        self.output_shape = (6 * future + length,)

    @torch.no_grad()
    def forward(self, inputs: Tensor) -> Float[Tensor, "batch length"]:
        """Return the features of the flights."""
        dtype = inputs.dtype if inputs.is_floating_point() else torch.get_default_dtype()
        frames = inputs.double().clamp(-LARGEST, LARGEST).cpu()
        observed = observed_frames(frames.unflatten(-1, (-1, len(PARTS))), self.step)
        estimate = estimate_states(observed, self.constants, self.noise, self.prior)
        moments = self.step * torch.arange(1, self.future + 1, dtype=torch.float64)
        times = torch.cat([observed.times, moments.expand(len(frames), -1)], 1)
        positions, jacobian = simulate_with_jacobian(estimate.state, times, self.constants)
        log_deviation = (
            (jacobian[:, -self.future :].flatten(1, 2) @ covariance_root(estimate.covariance))
            .square()
            .sum(-1)
        )
        log_deviation = (log_deviation + self.noise**2).log() / 2
        features = torch.cat([positions[:, -self.future :].flatten(1), log_deviation, frames], 1)
        return features.clamp(-LARGEST, LARGEST).to(inputs.device, dtype)
