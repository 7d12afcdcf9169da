"""Flights of thrown balls, observed and future positions, for checks of plugins that read or predict them."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from framework.flights.frames import future_names
from framework.flights.physics import Constants
from framework.flights.trajectories import simulate
from framework.target import Target

STEP = 0.016
"""Time between frames, seconds."""
SIGMA = 0.003
"""Standard deviation of the noise of observed positions from `simulate_windows`, metres."""
START = np.array([0.8, -4.1, -0.62, -0.6, 6.2, 1.6, 20.0, -30.0, 10.0])
"""Position (m), velocity (m/s) and spin (rad/s), in the first frame, of a ball that lands on the table."""
TWO_FRAMES = Target("real", future_names(2, STEP))
"""Target of a ball's positions in the next two frames."""


def falling_balls(count: int) -> Float[Tensor, "flight number"]:
    """Return flattened observations of `count` falling balls in six frames of five numbers each.

    The numbers are time (s), x, y, z (m), and whether the ball was seen, which is always true.
    """
    since = STEP * torch.arange(-5.0, 1.0).expand(count, -1)
    height = torch.linspace(-0.2, 0.2, count).unsqueeze(-1) - 4.9 * since.square()
    frames = [since, 0.5 * since, 5 * since - 3, height, torch.ones_like(since)]
    return torch.stack(frames, -1).flatten(1)


def simulate_windows(
    count: int, outliers: bool = False
) -> tuple[Float[Tensor, "flight 20 5"], Float[Tensor, "flight 35 3"], Float[Tensor, "flight 9"]]:
    """Return flights that begin near `START`: observed frames, future positions without noise, and initial states.

    About a tenth of the frames do not show the ball; all their numbers are 0.

    Args:
        count: Number of flights.
        outliers: If true, the observed position is wrong by 0.4 m along each axis in about a tenth of the frames.
    """
    random = np.random.default_rng(0)
    states = torch.from_numpy(
        START + random.normal(size=(count, 9)) * [0.1, 0.05, 0.05, 0.3, 0.3, 0.2, 40, 40, 40]
    )
    times = STEP * torch.arange(55, dtype=torch.float64).expand(count, -1)
    positions = simulate(states, times, Constants())[..., :3]
    observed = positions[:, :20] + SIGMA * torch.from_numpy(random.normal(size=(count, 20, 3)))
    present = torch.from_numpy(random.random((count, 20, 1)) > 0.1)
    if outliers:
        observed = observed + (torch.from_numpy(random.random((count, 20, 1))) < 0.1) * 0.4
    frames = torch.cat([times[:, :20, None] - times[:, 19:20, None], observed, torch.ones(count, 20, 1)], -1)
    return frames * present, positions[:, 20:], states
