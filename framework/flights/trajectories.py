"""Simulation of many flights at once, in torch: Runge-Kutta steps, and bounces that are found within a step."""

from typing import no_type_check

import torch
from jaxtyping import Float
from torch import Tensor

from framework.flights.physics import Constants, bounce

NEWTON = 4
"""Number of Newton steps by which the time of a bounce is computed.

They start from the root of a parabola, and after three steps the error is already below rounding.
"""


@no_type_check  # called for every step
def free_flight(
    state: Float[Tensor, "flight 9"], time: Float[Tensor, "flight"], constants: Constants
) -> Float[Tensor, "flight 9"]:
    """Return the state after `time` seconds without a table: one step of the classical Runge-Kutta method (order 4).

    For 16 ms at 6 m/s the error is below 1e-8 m (tests/test_flight_physics.py). The acceleration is evaluated four
    times per step, as the method requires. The spin decays independently of the motion, so its values at these four
    evaluations are the initial spin times polynomials of decay rate · `time`.
    """
    h = time.unsqueeze(-1)
    place, velocity, spin = state[:, :3], state[:, 3:6], state[:, 6:]
    gravity = state.new_tensor([0.0, 0.0, constants.gravity])
    lift, decay = constants.lift * spin, constants.spin_decay * h

    def faster(velocity: Tensor, left: Tensor | float) -> Tensor:
        """Return the acceleration as `physics.acceleration` does, but from (flight, 3) tensors.

        `left` is the share of the initial spin that has not decayed yet.
        """
        drag = constants.drag * (velocity.square().sum(-1, keepdim=True) + 1e-24).sqrt()
        return torch.linalg.cross(left * lift, velocity) - drag * velocity - gravity

    halved = 1 - decay / 2
    twice = 1 - decay / 2 * halved
    third = 1 - decay * twice
    a = faster(velocity, 1.0)
    b = faster(velocity + h / 2 * a, halved)
    c = faster(velocity + h / 2 * b, twice)
    d = faster(velocity + h * c, third)
    arrived = place + h * velocity + h.square() / 6 * (a + b + c)
    rest = 1 - decay / 6 * (1 + 2 * halved + 2 * twice + third)
    return torch.cat([arrived, velocity + h / 6 * (a + 2 * b + 2 * c + d), rest * spin], -1)


def step(
    state: Float[Tensor, "flight 9"], time: Float[Tensor, "flight"], constants: Constants
) -> Float[Tensor, "flight 9"]:
    """Return the state after `time` seconds, with at most one bounce during that time.

    If the ball would fall onto the table a second time within `time`, it is put onto the table without downward
    velocity, so that the number of bounces stays finite.
    """
    after = free_flight(state, time, constants)
    touching = constants.touching
    hits = (after[:, 2] < touching) & (state[:, 2] >= touching - 1e-9)
    rows = hits.nonzero()[:, 0]
    if not len(rows):
        return after
    before, whole = state[rows], time[rows]
    # Start at the later root of the parabola, then take Newton's steps along the flight itself.
    height, climb = before[:, 2] - touching, before[:, 5]
    root = (climb.square() + 2 * constants.gravity * height.clamp(min=0) + 1e-18).sqrt()
    until = torch.minimum(((climb + root) / constants.gravity).clamp(min=0), whole)
    for _ in range(NEWTON):
        bounce_state = free_flight(before, until, constants)
        until = until - (bounce_state[:, 2] - touching) / bounce_state[:, 5].clamp(max=-1e-3)
        until = torch.minimum(until.clamp(min=0), whole)
    bounce_state = free_flight(before, until, constants)
    u, v, w, a, b, c = bounce_state[:, 3:].unbind(-1)
    velocity, spin = bounce((u, v, w), (a, b, c), constants)
    level = torch.full_like(u, touching)
    left = torch.stack([bounce_state[:, 0], bounce_state[:, 1], level, *velocity, *spin], -1)
    risen = free_flight(left, whole - until, constants)
    lies = (risen[:, 2] < touching) & (risen[:, 1] < constants.far)
    risen = torch.where(lies.unsqueeze(-1) & (torch.arange(9) == 2), risen.clamp(min=touching), risen)
    risen = torch.where(lies.unsqueeze(-1) & (torch.arange(9) == 5), risen.clamp(min=0), risen)
    over = (bounce_state[:, 1] > constants.near) & (bounce_state[:, 1] < constants.far)
    return after.index_put((rows,), torch.where(over.unsqueeze(-1), risen, after[rows]))


def simulate(
    start: Float[Tensor, "flight 9"], times: Float[Tensor, "flight time"], constants: Constants
) -> Float[Tensor, "flight time 9"]:
    """Return the states of flights at `times`, seconds, not decreasing; `start` is the state at the first time.

    One step leads from each time to the next, so times should be at most about 20 ms apart.
    """
    states = [start]
    for number in range(1, times.shape[1]):
        states.append(step(states[-1], times[:, number] - times[:, number - 1], constants))
    return torch.stack(states, 1)


def simulate_with_jacobian(
    start: Float[Tensor, "flight 9"], times: Float[Tensor, "flight time"], constants: Constants
) -> tuple[Float[Tensor, "flight time 3"], Float[Tensor, "flight time 3 9"]]:
    """Return positions, and their derivatives with respect to the state at the start.

    The derivatives are central differences, computed for all states at once. In float64 they have nine correct digits
    (tests/test_flight_physics.py). They take a hundredth of the time of torch's forward-mode differentiation, which
    interprets each of about ten thousand small operations.
    """
    flights, time = times.shape
    shift = torch.diag(start.new_tensor([1e-5] * 6 + [1e-3] * 3))
    states = torch.cat([start[:, None], start[:, None] + shift, start[:, None] - shift], 1)  # (flight, 19, 9)
    positions = simulate(states.reshape(-1, 9), times.repeat_interleave(19, 0), constants)[..., :3]
    positions = positions.reshape(flights, 19, time, 3)
    change = (positions[:, 1:10] - positions[:, 10:]) / (2 * shift.diagonal()[:, None, None])
    return positions[:, 0], change.permute(0, 2, 3, 1)
