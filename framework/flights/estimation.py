"""Estimation of a ball's position, velocity and spin from observed frames: robust, and for many flights at once."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from framework.flights.physics import Constants
from framework.flights.trajectories import simulate_with_jacobian
from framework.least_squares.solver import least_squares

BELIEVED = 50.0
"""Distance from the origin, metres, beyond which a frame counts as missing."""
CAUCHY = 3.0
"""Scale c of Cauchy's loss, in standard deviations of the noise.

The larger a residual is beyond c, the less weight it has, so that an outlier has almost no influence.
"""
FIRST = 8
"""Number of observed frames from which the start of the search is computed."""
MOST = torch.tensor([BELIEVED] * 3 + [50.0] * 3 + [1000.0] * 3, dtype=torch.float64)
"""Largest absolute values of the numbers of a state: position (m), velocity (m/s) and spin (rad/s)."""


class ObservedFrames(NamedTuple):
    """Times and positions at which a ball was observed in each frame of several flights.

    Attributes:
        times: (flight, frame), s, not decreasing. A missing frame has the time at which it should have been observed.
            All frames before the first observed frame have the time of the first observed frame.
        places: positions of the ball, (flight, frame, 3), m, NaN if the frame is missing.
    """

    times: Tensor
    places: Tensor

    @property
    def observed(self) -> Bool[Tensor, "flight frame"]:
        """True for each frame that is not missing, (flight, frame)."""
        return ~self.places.isnan().any(-1)


class Estimate(NamedTuple):
    """Estimated state of each flight at the first frame.

    Attributes:
        state: position (m), velocity (m/s) and spin (rad/s).
        covariance: covariance of the state.
        cost: half the final sum of squared residuals. These are the residuals of positions in standard deviations of
            the noise, transformed by `cauchy`, and the state in standard deviations of the prior.
    """

    state: Float[Tensor, "flight 9"]
    covariance: Float[Tensor, "flight 9 9"]
    cost: Float[Tensor, "flight"]


class Prior(NamedTuple):
    """Prior density of a state: normal about 0, independent in every number.

    Attributes:
        place: standard deviation of each coordinate of the position, m.
        speed: standard deviation of each component of the velocity, m/s.
        spin: standard deviation of each component of the spin, rad/s.
    """

    place: float = 10.0
    speed: float = 10.0
    spin: float = 60.0

    @property
    def scale(self) -> Float[Tensor, "9"]:
        """Standard deviations of the nine numbers of a state."""
        return torch.tensor([self.place] * 3 + [self.speed] * 3 + [self.spin] * 3, dtype=torch.float64)


def observed_frames(frames: Float[Tensor, "flight frame 5"], step: float) -> ObservedFrames:
    """Return the times and positions of the observed frames, in double precision.

    Args:
        frames: numbers that a model reads (framework.flights.frames.PARTS).
        step: seconds between frames.
    """
    frames = frames.double()
    count = frames.shape[1]
    slots = step * (torch.arange(count, dtype=torch.float64, device=frames.device) - (count - 1))
    observed = (frames[..., 4] > 0.5) & (frames[..., 1:4].abs() <= BELIEVED).all(-1)
    times = torch.where(observed, frames[..., 0].clamp(slots - step / 2, slots + step / 2), slots)
    first = torch.where(observed, times, 0.0).amin(-1, keepdim=True)
    places = torch.where(observed.unsqueeze(-1), frames[..., 1:4], torch.nan)
    return ObservedFrames(torch.maximum(times, first), places)


def estimate_states(
    frames: ObservedFrames,
    constants: Constants,
    noise: float,
    prior: Prior = Prior(),  # noqa: B008 - never changed
    most: int = 40,
) -> Estimate:
    """Return the most probable state of each flight at the first frame, with its covariance.

    The state is found by least squares with Cauchy's loss, and with the prior as further residuals. Cauchy's loss c²/2
    log(1 + (r/c)²) of a residual r is half the square of c √log(1 + (r/c)²) (Holland & Welsch 1977).

    Args:
        frames: the observed frames.
        constants: constants of the physics.
        noise: standard deviation of the noise in each coordinate, m.
        prior: prior density of a state.
        most: largest number of steps of the search.
    """
    scale = prior.scale.to(frames.times.device)

    def model(states: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        places, slopes = simulate_with_jacobian(states, frames.times[rows], constants)
        residual = ((places - frames.places[rows]) / noise).flatten(1)
        bent, steep = cauchy(residual)
        jacobian = steep.unsqueeze(-1) * slopes.flatten(1, 2) / noise
        own = torch.diag_embed((1 / scale).expand(len(states), 9))
        return torch.cat([bent, states / scale], 1), torch.cat([jacobian, own], 1)

    begin = guess_states(frames, constants.gravity)
    bound = MOST.to(frames.times.device)
    # An error of a tenth of a per cent of a standard deviation does not matter.
    solution = least_squares(model, begin, -bound, bound, most=most, decrease=1e-7, step=1e-9)
    residuals, jacobian = model(solution.parameters, torch.arange(len(begin)))
    jacobian = torch.where(residuals.isnan().unsqueeze(-1), 0.0, jacobian)
    precision = jacobian.mT @ jacobian * scale * scale.unsqueeze(-1)  # scaled so that the prior's part is 1
    covariance = torch.linalg.inv(precision) * scale * scale.unsqueeze(-1)
    return Estimate(solution.parameters, (covariance + covariance.mT) / 2, solution.cost)


def cauchy(residual: Float[Tensor, "*shape"]) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*shape"]]:
    """Return c √log(1 + (r/c)²) with the sign of the residual r, and its derivative by r; c is CAUCHY."""
    square = (residual / CAUCHY).square()
    root = CAUCHY * torch.log1p(square).sqrt()
    steep = torch.where(residual.abs() < 1e-6, 1.0, residual.abs() / (root * (1 + square)))
    return torch.copysign(root, residual), steep


def guess_states(frames: ObservedFrames, gravity: float) -> Float[Tensor, "flight 9"]:
    """Return an initial guess of the state at the first frame.

    The velocity consists of medians of the slopes between pairs of the first FIRST observed frames (Theil 1950; Sen
    1968), which hardly change if up to a third of the frames are outliers. The spin is 0. If fewer than two frames are
    observed, the velocity is 0; if none is observed, the position is 0 too.
    """
    observed = frames.observed & (frames.observed.cumsum(-1) <= FIRST)
    since = frames.times - frames.times[:, :1]
    straight = torch.where(observed.unsqueeze(-1), frames.places, torch.nan)
    straight = straight + torch.stack([0 * since, 0 * since, gravity / 2 * since.square()], -1)
    intervals = since.unsqueeze(-1) - since.unsqueeze(-2)
    rise = straight.unsqueeze(-2) - straight.unsqueeze(-3)
    slopes = torch.where(
        (intervals > 1e-4).unsqueeze(-1), rise / intervals.clamp(min=1e-4).unsqueeze(-1), torch.nan
    )
    speed = slopes.flatten(1, 2).nanmedian(1).values
    place = (straight - speed.unsqueeze(1) * since.unsqueeze(-1)).nanmedian(1).values
    place = torch.where(place.isnan(), straight.nanmedian(1).values, place)
    state = torch.cat([place, speed, torch.zeros_like(place)], -1).nan_to_num(0.0)
    return state.clamp(-0.9 * MOST.to(state), 0.9 * MOST.to(state))


def covariance_root(covariance: Float[Tensor, "flight 9 9"]) -> Float[Tensor, "flight 9 9"]:
    """Return R with R Rᵀ equal to the covariance.

    If rounding has made the covariance indefinite, R Rᵀ is the nearest positive semi-definite matrix.
    """
    values, vectors = torch.linalg.eigh(covariance)
    return vectors * values.clamp(min=0).sqrt().unsqueeze(-2)
