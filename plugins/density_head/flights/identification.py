"""Identification of the constants of a ball and a table from flights, together with the states of all flights."""

from dataclasses import asdict, replace

import torch
from jaxtyping import Float
from torch import Tensor

from framework.flights.estimation import ObservedFrames, Prior, cauchy
from framework.flights.physics import Constants
from framework.flights.trajectories import simulate, simulate_with_jacobian

FITTED = ("drag", "lift", "restitution", "friction", "surface")
"""Names of the constants that are identified."""
LOW, HIGH = (0.0, -0.02, 0.3, 0.0, -0.3), (1.0, 0.02, 1.0, 1.0, 0.3)
"""Bounds of the constants; those of the surface are metres from its value in the config."""
SIZES = (0.05, 0.002, 0.05, 0.05, 0.01)
"""Typical step size of each constant."""
ROUNDS = 40
"""Largest number of steps."""
ENOUGH = 3e-4
"""Share of the cost; the search ends after two steps in a row that save less. For 32 windows it is under half a nat."""


def with_found(constants: Constants, numbers: Float[Tensor, "constant"]) -> Constants:
    """Return the constants with `FITTED` replaced."""
    return replace(constants, **dict(zip(FITTED, numbers.tolist(), strict=True)))


def found_of(constants: Constants) -> Float[Tensor, "constant"]:
    """Return the values of the constants `FITTED`."""
    return torch.tensor([asdict(constants)[name] for name in FITTED], dtype=torch.float64)


def bounds_of(constants: Constants) -> tuple[Float[Tensor, "constant"], Float[Tensor, "constant"]]:
    """Return bounds of stored values of `FITTED`: the range of `identified`, extended to the config's values."""
    given = found_of(constants)
    middle = torch.zeros_like(given)
    middle[-1] = given[-1]
    low, high = (middle + torch.tensor(bound, dtype=torch.float64) for bound in (LOW, HIGH))
    return torch.minimum(low, given), torch.maximum(high, given)


def identified(
    seen: ObservedFrames, given: Constants, states: Float[Tensor, "flight 9"], noise: float, prior: Prior
) -> tuple[Float[Tensor, "constant"], Float[Tensor, "flight 9"]]:
    """Return the constants `FITTED` and the states that fit best, by Levenberg and Marquardt's method.

    A flight's state affects no other flight's residuals. So each state is eliminated on its own, and the remaining
    system has as many equations as there are constants (Schur's complement, as in bundle adjustment: Triggs et al.
    2000, §6.1).

    Args:
        seen: whole flights, from before the window to after it.
        given: initial constants.
        states: states at the first frames, from which the search starts.
        noise: standard deviation of each coordinate, m.
        prior: prior of the states.
    """
    numbers = found_of(given)
    middle = torch.tensor([0.0, 0.0, 0.0, 0.0, given.surface], dtype=torch.float64)
    low, high = (middle + torch.tensor(bound, dtype=torch.float64) for bound in (LOW, HIGH))
    sizes = torch.tensor(SIZES, dtype=torch.float64)
    numbers = numbers.clamp(low, high)

    def paths(numbers: Tensor, states: Tensor) -> Tensor:
        return simulate(states, seen.times, with_found(given, numbers))[..., :3]

    def cost(numbers: Tensor, states: Tensor) -> float:
        apart = cauchy((paths(numbers, states) - seen.places) / noise)[0].nan_to_num(0.0)
        return float(apart.square().sum() + (states / prior.scale).square().sum()) / 2

    least, damping, quiet = cost(numbers, states), 1e-3, 0
    linear = None
    for _ in range(ROUNDS):
        if linear is None:
            places, slopes = simulate_with_jacobian(states, seen.times, with_found(given, numbers))
            bent, steep = cauchy((places - seen.places) / noise)
            bent, steep = bent.nan_to_num(0.0).flatten(1), steep.nan_to_num(0.0).unsqueeze(-1) / noise
            shifts = torch.diag(sizes / 1000)
            turn = [(paths(numbers + one, states) - places) / 1e-3 for one in shifts]
            # states are in units of the prior, constants in units of SIZES
            by_state = (steep * slopes).flatten(1, 2) * prior.scale
            by_constant = (steep * torch.stack(turn, -1)).flatten(1, 2)
            pull = (by_state.mT @ bent.unsqueeze(-1)).squeeze(-1) + states / prior.scale
            push = (by_constant.mT @ bent.unsqueeze(-1)).squeeze(-1).sum(0)
            own = by_state.mT @ by_state + torch.eye(9, dtype=torch.float64)
            linear = (own, by_state.mT @ by_constant, (by_constant.mT @ by_constant).sum(0), pull, push)
        push = linear[-1]
        held = (numbers <= low) & (push > 0) | (numbers >= high) & (push < 0)
        state_step, step = _step(*linear, damping, held)
        tried = (numbers + step * sizes).clamp(low, high)
        moved = states + state_step * prior.scale
        now = cost(tried, moved)
        if now < least:
            quiet = quiet + 1 if least - now < ENOUGH * least else 0
            numbers, states, least, linear = tried, moved, now, None
            damping = max(damping / 10, 1e-12)
        else:
            damping *= 10
        if quiet == 2 or damping > 1e8:
            break
    return numbers, states


def _step(
    own: Float[Tensor, "flight 9 9"],
    both: Float[Tensor, "flight 9 constant"],
    whole: Float[Tensor, "constant constant"],
    pull: Float[Tensor, "flight 9"],
    push: Float[Tensor, "constant"],
    damping: float,
    held: Tensor,
) -> tuple[Float[Tensor, "flight 9"], Float[Tensor, "constant"]]:
    """Return steps of states and constants that solve the damped normal equations; constants at a bound stay."""
    own = own + damping * torch.diag_embed(own.diagonal(dim1=-2, dim2=-1))
    # the diagonal is 0 for a constant that no residual depends on
    whole = whole + torch.diag(damping * whole.diagonal() + 1e-9 + 1e12 * held)
    factor = torch.linalg.cholesky(own)
    solved = torch.cholesky_solve(torch.cat([both, pull.unsqueeze(-1)], -1), factor)
    left = whole - (both.mT @ solved[..., :-1]).sum(0)
    step = torch.linalg.solve(left, (both.mT @ solved[..., -1:]).sum(0)[:, 0] - push)
    return -solved[..., -1] - solved[..., :-1] @ step, step
