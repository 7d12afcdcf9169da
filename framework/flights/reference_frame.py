"""Checks that flights and constants belong to the same frame of reference: the axis that points up, and the table."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from framework.errors import ConfigError
from framework.flights.estimation import ObservedFrames
from framework.flights.physics import Constants

FEWEST = 5
"""Smallest number of bounces, or of pieces of flights, with which `require_frame` checks the frame of reference."""
PIECE = 12
"""Number of frames of a piece of a flight."""
FALL = (5.0, 20.0)
"""Range of the acceleration of a falling ball, m/s²; a value outside it comes from noise or from another unit."""
STEEP = 0.85
"""Smallest cosine of the angle between the acceleration and the downward axis; drag alone gives about 0.95."""
TURN = 0.3
"""Smallest vertical speed, m/s, before and after a bounce."""
NEAR_HEIGHT = 0.05
"""Difference of two heights, m, up to which they count as equal.

Bounces with a larger median deviation from their median height say nothing about the table. If their median height is
equal to that of the config, `require_frame` returns the height in the config.
"""
OUTSIDE = 0.2
"""Largest share of bounces beyond the ends of the table that is accepted as errors of the observations."""


def accelerations(observations: ObservedFrames) -> Float[Tensor, "piece 3"]:
    """Return the acceleration of the parabola that fits each piece of PIECE consecutive frames best, m/s².

    Consecutive pieces of a flight overlap by half. Most pieces are too short to hold a bounce. Pieces in which many
    frames are missing are left out.
    """
    length = min(PIECE, observations.times.shape[1])
    times = observations.times.unfold(1, length, length // 2).flatten(0, 1)
    places = observations.places.unfold(1, length, length // 2).mT.flatten(0, 1)
    seen = observations.observed.unfold(1, length, length // 2).flatten(0, 1)
    chosen = seen.sum(1) >= 2 * PIECE // 3
    times, places, weight = times[chosen], places[chosen], seen[chosen].double()
    times = times - (times * weight).sum(1, keepdim=True) / weight.sum(1, keepdim=True)
    basis = torch.stack([torch.ones_like(times), times, times.square() / 2], -1)
    weighted = (basis * weight.unsqueeze(-1)).mT
    return torch.linalg.lstsq(weighted @ basis, weighted @ places.nan_to_num(0.0)).solution[:, 2]


def bounces(observations: ObservedFrames) -> Float[Tensor, "bounce 3"]:
    """Return the positions of the ball's centre at its bounces, m.

    A bounce lies between two frames: the ball falls before the first of them, and rises after the second. One line goes
    through the two frames before the bounce, and another line through the two frames after it. The height of the bounce
    is that of the point where these lines meet.
    """
    times, places = observations.times, observations.places
    gaps = times.diff(dim=1).clamp(min=1e-6)
    speeds = places[..., 2].diff(dim=1) / gaps
    before, after = speeds[:, :-2], speeds[:, 2:]
    gap, start, end = gaps[:, 1:-1], places[:, 1:-2], places[:, 2:-1]
    moment = (end[..., 2] - after * gap - start[..., 2]) / (before - after)
    inside = (before < -TURN) & (after > TURN) & (moment >= 0) & (moment <= gap)
    share = (moment / gap).unsqueeze(-1)
    place = start + share * (end - start)
    place = torch.cat([place[..., :2], (start[..., 2] + before * moment).unsqueeze(-1)], -1)
    return place[inside]


def require_frame(observations: ObservedFrames, constants: Constants, by: str) -> Constants:
    """Check the frame of reference of flights, and return the constants with the height of the table in this frame.

    The vertical axis is checked if there are at least five pieces of flights (of PIECE frames each), and if the size of
    their median acceleration is that of a falling ball. The table is checked, and its height set, if there are at least
    five bounces at nearly equal heights. Otherwise, or if this height is within NEAR_HEIGHT of that in the constants,
    the constants are returned unchanged.

    Args:
        observations: whole flights.
        constants: constants of the config.
        by: subject of messages, such as "density_head ballistic".

    Raises:
        ConfigError: the ball does not fall along -z, or bounces beyond the ends of the table.
    """
    falls = accelerations(observations)
    if len(falls) >= FEWEST:
        fall = falls.median(0).values
        size = float(fall.norm())
        if FALL[0] < size < FALL[1] and float(-fall[2]) < STEEP * size:
            axis = int(fall.abs().argmax())
            name = f"{'-' if fall[axis] < 0 else '+'}{'xyz'[axis]}"
            raise ConfigError(
                f"The flights fall along {name}: their median acceleration is "
                f"({', '.join(f'{number:.1f}' for number in fall.tolist())}) m/s². {by} expects that z points up. "
                "Write the columns of the flights such that z points up and y along the table."
            )
    points = bounces(observations)
    if len(points) < FEWEST:
        return constants
    height = float(points[:, 2].median())
    if float((points[:, 2] - height).abs().median()) > NEAR_HEIGHT:
        return constants
    places = points[(points[:, 2] - height).abs() <= 3 * NEAR_HEIGHT, 1]
    beyond = (places < constants.near) | (places > constants.far)
    if float(beyond.double().mean()) > OUTSIDE:
        raise ConfigError(
            f"The ball bounces at y from {float(places.min()):.2f} to {float(places.max()):.2f} m, but the table of "
            f"{by} lies from near = {constants.near:g} to far = {constants.far:g} m. Set near and far of {by} to the "
            "ends of the table in the frame of the recordings."
        )
    if abs(height - constants.touching) <= NEAR_HEIGHT:
        return constants
    return replace(constants, surface=height - constants.radius)
