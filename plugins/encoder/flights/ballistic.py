"""Features of a flight by physics: the predicted path of the differential equation, and its standard deviations."""

from collections.abc import Iterable, Mapping
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.encoder import ChecksTraining, Encoder
from framework.errors import ConfigError
from framework.flights.estimation import (
    ObservedFrames,
    Prior,
    covariance_root,
    estimate_states,
    observed_frames,
)
from framework.flights.frames import PARTS
from framework.flights.physics import Constants
from framework.flights.reference_frame import require_frame
from framework.flights.trajectories import simulate_with_jacobian
from plugins.encoder.flights.extrapolation import count_frames

LARGEST = 1e4
"""Bound on the magnitude of inputs and features; larger ones are clamped."""


class BallisticEncoder(Encoder, ChecksTraining):
    """Predicted flight of the ball by its differential equation, as features.

    Features: x, y and z at each future frame, m; the logarithms of their standard deviations; and the observed frames,
    each with the numbers of `framework.flights.frames.PARTS`: time, x, y, z, and whether the ball was seen.

    The constants are those of the config, or those that a run of `density_head=ballistic` has fitted. Nothing is
    learnt. Before the training, `check_training` compares the table with the bounces of the training flights.

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
        frames, observed = self._observe(inputs)
        estimate = estimate_states(observed, self.constants, self.noise, self.prior)
        times = torch.cat([observed.times, self._future_times(len(frames))], 1)
        positions, jacobian = simulate_with_jacobian(estimate.state, times, self.constants)
        log_deviation = (
            (jacobian[:, -self.future :].flatten(1, 2) @ covariance_root(estimate.covariance))
            .square()
            .sum(-1)
        )
        log_deviation = (log_deviation + self.noise**2).log() / 2
        features = torch.cat([positions[:, -self.future :].flatten(1), log_deviation, frames], 1)
        return features.clamp(-LARGEST, LARGEST).to(inputs.device, dtype)

    def check_training(self, batches: Iterable[Mapping[str, Tensor]]) -> None:
        """Compare the vertical axis and the table with whole training windows: observed and future frames.

        Raises:
            ConfigError: the flights fall along another axis, or bounce beside the table or at another height.
        """
        inputs, targets = zip(
            *((batch["input"].flatten(1), batch["target"]) for batch in batches), strict=True
        )
        _, observed = self._observe(torch.cat(inputs))
        future = torch.cat(targets).double().cpu()
        if future.shape[1:] == (3 * self.future,):  # positions at the future frames
            observed = self._extend(observed, future.unflatten(-1, (self.future, 3)))
        constants = require_frame(observed, self.constants, "encoder ballistic")
        if constants != self.constants:
            raise ConfigError(
                f"The ball bounces at a height of {constants.touching:.3f} m, but encoder.ballistic.surface and "
                f"encoder.ballistic.radius put the bounces at {self.constants.touching:.3f} m. Set "
                f"encoder.ballistic.surface={constants.surface:.3f}."
            )

    def _observe(self, inputs: Tensor) -> tuple[Tensor, ObservedFrames]:
        """Return the bounded inputs, float64, and the frames that they hold."""
        frames = inputs.double().clamp(-LARGEST, LARGEST).cpu()
        return frames, observed_frames(frames.unflatten(-1, (-1, len(PARTS))), self.step)

    def _extend(self, observed: ObservedFrames, future: Float[Tensor, "batch future 3"]) -> ObservedFrames:
        """Return the observed frames, followed by the positions at the future frames."""
        times = torch.cat([observed.times, self._future_times(len(future))], 1)
        return ObservedFrames(times, torch.cat([observed.places, future], 1))

    def _future_times(self, count: int) -> Float[Tensor, "batch future"]:
        """Return the times of the future frames of `count` flights, s."""
        return (self.step * torch.arange(1, self.future + 1, dtype=torch.float64)).expand(count, -1)
