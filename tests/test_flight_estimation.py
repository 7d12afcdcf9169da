"""Estimates of states from frames, compared with SciPy's robust least squares, with and without outliers."""

import numpy as np
import torch
from scipy.optimize import least_squares

from framework.flights.estimation import cauchy, estimate_states, observed_frames
from framework.flights.physics import Constants
from framework.flights.trajectories import simulate
from framework.testing.flights import SIGMA, simulate_windows


def test_states_are_those_of_scipys_robust_least_squares() -> None:
    frames, _, _ = simulate_windows(4)
    seen = observed_frames(frames, 0.016)
    found = estimate_states(seen, Constants(), SIGMA, most=200)
    for row in range(4):
        there = seen.observed[row]

        def residuals(state: np.ndarray, row: int = row, there: torch.Tensor = there) -> np.ndarray:
            places = simulate(torch.from_numpy(state)[None], seen.times[row : row + 1], Constants())[0, :, :3]
            apart = ((places - seen.places[row])[there] / SIGMA).flatten()
            return np.concatenate([cauchy(apart)[0].numpy(), state / ([10] * 6 + [60] * 3)])

        best = least_squares(
            residuals, found.state[row].numpy(), x_scale=[0.01] * 3 + [0.1] * 3 + [10] * 3, xtol=1e-12
        )
        assert found.cost[row] <= best.cost * (1 + 1e-5)


def test_outliers_do_not_move_the_state() -> None:
    clean, future, _ = simulate_windows(40)
    dirty, _, _ = simulate_windows(40, outliers=True)
    errors = []
    for frames in (clean, dirty):
        seen = observed_frames(frames, 0.016)
        found = estimate_states(seen, Constants(), SIGMA)
        times = torch.cat([seen.times, 0.016 * torch.arange(1, 36).double().expand(40, -1)], 1)
        places = simulate(found.state, times, Constants())[:, 20:, :3]
        errors.append((places - future).norm(dim=-1).mean(0).median())
    assert errors[1] < 1.5 * errors[0] and errors[0] < 0.05
