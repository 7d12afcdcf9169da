"""Where a ball was, how fast and with what spin, from the frames in which it was seen: robust, many flights at once."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from framework.flights.physics import Constants
from framework.flights.trajectories import flown_with_slopes
from framework.least_squares.solver import least_squares

BELIEVED = 50.0
"""Metres from the origin; a frame beyond them counts as missing."""
CAUCHY = 3.0
"""Standard deviations of the noise beyond which a frame counts less and less, so that an outlier counts for nothing."""
FIRST = 8
"""Seen frames from which the start of the search comes."""
MOST = torch.tensor([BELIEVED] * 3 + [50.0] * 3 + [1000.0] * 3, dtype=torch.float64)
"""Largest state: m, m/s, rad/s."""


class Seen(NamedTuple):
    """Frames of flights.

    Attributes:
        times: (flight, frame), s, not decreasing. A frame that is missing has the time at which it should have been;
            before the first that is there all have that one's time.
        places: (flight, frame, 3), m, NaN where the frame is missing.
    """

    times: Tensor
    places: Tensor

    @property
    def there(self) -> Bool[Tensor, "flight frame"]:
        return ~self.places.isnan().any(-1)


class Estimate(NamedTuple):
    """A state at the first frame, its covariance, and half the sum of squared residuals that was left."""

    state: Float[Tensor, "flight 9"]
    covariance: Float[Tensor, "flight 9 9"]
    cost: Float[Tensor, "flight"]


class Prior(NamedTuple):
    """What is believed of a state before anything is seen: normal about 0, standard deviations of m, m/s and rad/s."""

    place: float = 10.0
    speed: float = 10.0
    spin: float = 60.0

    @property
    def scale(self) -> Float[Tensor, "9"]:
        return torch.tensor([self.place] * 3 + [self.speed] * 3 + [self.spin] * 3, dtype=torch.float64)


def seen_of(frames: Float[Tensor, "flight frame 5"], step: float) -> Seen:
    """From what a model reads (framework.flights.frames.PARTS), in double precision."""
    frames = frames.double()
    count = frames.shape[1]
    slots = step * (torch.arange(count, dtype=torch.float64, device=frames.device) - (count - 1))
    there = (frames[..., 4] > 0.5) & (frames[..., 1:4].abs() <= BELIEVED).all(-1)
    times = torch.where(there, frames[..., 0].clamp(slots - step / 2, slots + step / 2), slots)
    first = torch.where(there, times, 0.0).amin(-1, keepdim=True)
    places = torch.where(there.unsqueeze(-1), frames[..., 1:4], torch.nan)
    return Seen(torch.maximum(times, first), places)


def estimated(
    seen: Seen,
    constants: Constants,
    noise: float,
    prior: Prior = Prior(),  # noqa: B008 - never changed
    start: Float[Tensor, "flight 9"] | None = None,
    most: int = 40,
) -> Estimate:
    """The likeliest state of each flight: least squares with Cauchy's loss, and the prior as further residuals.

    Cauchy's loss c²/2 log(1 + (r/c)²) of a residual r is half the square of c √log(1 + (r/c)²) (Holland & Welsch 1977).

    Args:
        noise: standard deviation of each coordinate, m.
        start: of the search; None: straight lines through the first frames say.
        most: steps of the search.
    """
    scale = prior.scale.to(seen.times.device)

    def model(states: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        places, slopes = flown_with_slopes(states, seen.times[rows], constants)
        apart = ((places - seen.places[rows]) / noise).flatten(1)
        bent, steep = cauchy(apart)
        jacobian = steep.unsqueeze(-1) * slopes.flatten(1, 2) / noise
        own = torch.diag_embed((1 / scale).expand(len(states), 9))
        return torch.cat([bent, states / scale], 1), torch.cat([jacobian, own], 1)

    begin = guessed(seen, constants.gravity) if start is None else start
    bound = MOST.to(seen.times.device)
    # of a tenth of a per cent of a standard deviation nothing follows
    found = least_squares(model, begin, -bound, bound, most=most, decrease=1e-7, step=1e-9)
    residuals, jacobian = model(found.parameters, torch.arange(len(begin)))
    jacobian = torch.where(residuals.isnan().unsqueeze(-1), 0.0, jacobian)
    precision = (
        jacobian.mT @ jacobian * scale * scale.unsqueeze(-1)
    )  # of the order of 1 and more: the prior's part is 1
    covariance = torch.linalg.inv(precision) * scale * scale.unsqueeze(-1)
    return Estimate(found.parameters, (covariance + covariance.mT) / 2, found.cost)


def cauchy(apart: Float[Tensor, "*shape"]) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*shape"]]:
    """c √log(1 + (r/c)²) with r's sign, and its derivative."""
    square = (apart / CAUCHY).square()
    root = CAUCHY * torch.log1p(square).sqrt()
    steep = torch.where(apart.abs() < 1e-6, 1.0, apart.abs() / (root * (1 + square)))
    return torch.copysign(root, apart), steep


def guessed(seen: Seen, gravity: float) -> Float[Tensor, "flight 9"]:
    """A state at the first frame by medians of slopes between pairs of the first frames (Theil 1950, Sen 1968), which a
    third of outliers does not move; without spin, and 0 where fewer than two frames are there."""
    there = seen.there & (seen.there.cumsum(-1) <= FIRST)
    since = seen.times - seen.times[:, :1]
    straight = torch.where(there.unsqueeze(-1), seen.places, torch.nan)
    straight = straight + torch.stack([0 * since, 0 * since, gravity / 2 * since.square()], -1)
    apart = since.unsqueeze(-1) - since.unsqueeze(-2)
    rise = straight.unsqueeze(-2) - straight.unsqueeze(-3)
    slopes = torch.where((apart > 1e-4).unsqueeze(-1), rise / apart.clamp(min=1e-4).unsqueeze(-1), torch.nan)
    speed = slopes.flatten(1, 2).nanmedian(1).values
    place = (straight - speed.unsqueeze(1) * since.unsqueeze(-1)).nanmedian(1).values
    place = torch.where(place.isnan(), straight.nanmedian(1).values, place)
    state = torch.cat([place, speed, torch.zeros_like(place)], -1).nan_to_num(0.0)
    return state.clamp(-0.9 * MOST.to(state), 0.9 * MOST.to(state))


def root(covariance: Float[Tensor, "flight 9 9"]) -> Float[Tensor, "flight 9 9"]:
    """R with R Rᵀ the covariance; of one that rounding has made indefinite the nearest there is."""
    values, vectors = torch.linalg.eigh(covariance)
    return vectors * values.clamp(min=0).sqrt().unsqueeze(-2)
