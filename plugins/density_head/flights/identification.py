"""Identification of the constants of a ball and a table from flights, together with the states of all flights."""

import math
from dataclasses import asdict, replace

import torch
from jaxtyping import Float
from torch import Tensor

from framework.flights.estimation import ObservedFrames, Prior, cauchy
from framework.flights.physics import Constants
from framework.flights.trajectories import simulate, simulate_with_jacobian

FITTED = ("drag", "lift", "restitution", "friction", "surface")
"""Names of the constants that `identify` fits."""
LOW, HIGH = (0.0, -0.02, 0.3, 0.0, -0.3), (1.0, 0.02, 1.0, 1.0, 0.3)
"""Bounds of the constants in `FITTED`.

The bounds of "surface", the height of the table, are metres above its value at the start of the search.
"""
UNITS = (" 1/m", "", "", "", " m")
"""Unit of each constant in `FITTED`, as messages state it."""
HIGHEST = 20.0
"""Largest accepted difference, m, between the height of the table in a stored head and in the config."""
SIZES = (0.05, 0.002, 0.05, 0.05, 0.01)
"""Typical step size of each constant in `FITTED`, in its unit."""
ROUNDS = 40
"""Largest number of steps of the search."""
ENOUGH = 3e-4
"""Share of the cost: the search ends after two successive steps that lower the cost by less than this share.

For 32 windows the share is less than half a nat.
"""


def replace_constants(constants: Constants, numbers: Float[Tensor, "constant"]) -> Constants:
    """Return the constants, with the values of those in `FITTED` replaced by `numbers`."""
    return replace(constants, **dict(zip(FITTED, numbers.tolist(), strict=True)))


def fitted_constants(constants: Constants) -> Float[Tensor, "constant"]:
    """Return the values of the constants in `FITTED`, float64."""
    return torch.tensor([asdict(constants)[name] for name in FITTED], dtype=torch.float64)


def constant_bounds(constants: Constants) -> tuple[Float[Tensor, "constant"], Float[Tensor, "constant"]]:
    """Return lower and upper bounds of the constants in `FITTED`, which the values in a stored head must satisfy.

    They are the bounds of `identify`, extended to the values of the config (`constants`) if these lie outside. The
    height of the table may be any height at which flights bounce.
    """
    values = fitted_constants(constants)
    low, high = (torch.tensor(bound, dtype=torch.float64) for bound in (LOW, HIGH))
    low[-1], high[-1] = values[-1] - HIGHEST, values[-1] + HIGHEST
    return torch.minimum(low, values), torch.maximum(high, values)


def identify(
    observations: ObservedFrames,
    initial: Constants,
    states: Float[Tensor, "flight 9"],
    noise: float,
    prior: Prior,
) -> tuple[Float[Tensor, "constant"], Float[Tensor, "flight 9"], Float[Tensor, "constant"]]:
    """Return the values of `FITTED` that fit best, the states, and the standard errors of the values.

    The search is Levenberg and Marquardt's method. The standard errors are the roots of the diagonal of the inverse
    Gauss-Newton Hessian in which the states are eliminated. These standard errors hold if the model is right and the
    residuals have the standard deviation `noise`. The standard error of a constant that no flight determines is
    infinite.

    A flight's state affects no other flight's residuals. So each state is eliminated on its own, and the remaining
    system has as many equations as there are constants (Schur's complement, as in bundle adjustment: Triggs et al.
    2000, §6.1).

    Args:
        observations: frames of whole flights: the frames that a model reads, and those that it predicts.
        initial: constants from which the search starts.
        states: states at the first frames, from which the search starts.
        noise: standard deviation of the measurement error of each coordinate, m.
        prior: prior density of the states at the first frames.
    """
    numbers = fitted_constants(initial)
    middle = torch.tensor([0.0, 0.0, 0.0, 0.0, initial.surface], dtype=torch.float64)
    low, high = (middle + torch.tensor(bound, dtype=torch.float64) for bound in (LOW, HIGH))
    sizes = torch.tensor(SIZES, dtype=torch.float64)
    numbers = numbers.clamp(low, high)

    def paths(numbers: Tensor, states: Tensor) -> Tensor:
        return simulate(states, observations.times, replace_constants(initial, numbers))[..., :3]

    def cost(numbers: Tensor, states: Tensor) -> float:
        residuals = cauchy((paths(numbers, states) - observations.places) / noise)[0].nan_to_num(0.0)
        return float(residuals.square().sum() + (states / prior.scale).square().sum()) / 2

    def linearise(numbers: Tensor, states: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        places, slopes = simulate_with_jacobian(
            states, observations.times, replace_constants(initial, numbers)
        )
        bent, steep = cauchy((places - observations.places) / noise)
        bent, steep = bent.nan_to_num(0.0).flatten(1), steep.nan_to_num(0.0).unsqueeze(-1) / noise
        shifts = torch.diag(sizes / 1000)
        turn = [(paths(numbers + shift, states) - places) / 1e-3 for shift in shifts]
        # states are in units of the prior, constants in units of SIZES
        by_state = (steep * slopes).flatten(1, 2) * prior.scale
        by_constant = (steep * torch.stack(turn, -1)).flatten(1, 2)
        pull = (by_state.mT @ bent.unsqueeze(-1)).squeeze(-1) + states / prior.scale
        push = (by_constant.mT @ bent.unsqueeze(-1)).squeeze(-1).sum(0)
        own = by_state.mT @ by_state + torch.eye(9, dtype=torch.float64)
        return own, by_state.mT @ by_constant, (by_constant.mT @ by_constant).sum(0), pull, push

    least, damping, quiet = cost(numbers, states), 1e-3, 0
    linear = None
    for _ in range(ROUNDS):
        if linear is None:
            linear = linearise(numbers, states)
        push = linear[-1]
        at_bound = (numbers <= low) & (push > 0) | (numbers >= high) & (push < 0)
        state_step, step = _step(*linear, damping, at_bound)
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
    own, both, whole, *_ = linearise(numbers, states) if linear is None else linear
    information = whole - (both.mT @ torch.linalg.solve(own, both)).sum(0)
    values, vectors = torch.linalg.eigh(information)
    determined = values > 1e-9 * values.amax().clamp(min=1e-300)
    variance = (
        (vectors.square() / torch.where(determined, values, 0.0)).nan_to_num(0.0, posinf=math.inf).sum(1)
    )
    return numbers, states, variance.sqrt() * sizes


def _step(
    own: Float[Tensor, "flight 9 9"],
    both: Float[Tensor, "flight 9 constant"],
    whole: Float[Tensor, "constant constant"],
    pull: Float[Tensor, "flight 9"],
    push: Float[Tensor, "constant"],
    damping: float,
    at_bound: Tensor,
) -> tuple[Float[Tensor, "flight 9"], Float[Tensor, "constant"]]:
    """Return the steps of states and constants that solve the damped normal equations.

    Args:
        own: block of the Gauss-Newton Hessian for the state of each flight.
        both: block for the state of each flight and the constants.
        whole: block for the constants.
        pull: gradient of the cost in the state of each flight.
        push: gradient of the cost in the constants.
        damping: factor on the diagonal that is added to each diagonal block (Levenberg and Marquardt).
        at_bound: true for constants that must not move.
    """
    own = own + damping * torch.diag_embed(own.diagonal(dim1=-2, dim2=-1))
    # the diagonal is 0 for a constant that no residual depends on
    whole = whole + torch.diag(damping * whole.diagonal() + 1e-9 + 1e12 * at_bound)
    factor = torch.linalg.cholesky(own)
    solved = torch.cholesky_solve(torch.cat([both, pull.unsqueeze(-1)], -1), factor)
    left = whole - (both.mT @ solved[..., :-1]).sum(0)
    step = torch.linalg.solve(left, (both.mT @ solved[..., -1:]).sum(0)[:, 0] - push)
    return -solved[..., -1] - solved[..., :-1] @ step, step
