"""Places where paths come down through a plane, and how well drawn paths predict the true place."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from framework.flights.frames import PARTS


class Shown(NamedTuple):
    """One prediction that the figure shows, metres: seen positions that were read (frame, 3), true future, draws."""

    read: Float[Tensor, "frame 3"]
    future: Float[Tensor, "time 3"]
    draws: Float[Tensor, "draw time 3"]


def last_seen(inputs: Tensor | None, truth: Float[Tensor, "batch time 3"]) -> Float[Tensor, "batch 3"]:
    """Return where the ball was seen last, metres; NaN where inputs lack the fields `PARTS` or never saw the ball."""
    nowhere = torch.full_like(truth[:, 0], torch.nan)
    if inputs is None or inputs.dim() != 2 or inputs.shape[1] % len(PARTS):
        return nowhere
    frames = inputs.to(truth).unflatten(-1, (-1, len(PARTS)))
    seen = frames[..., 4] > 0.5
    latest = frames[..., 0].where(seen, -torch.inf).argmax(-1)
    places = frames[torch.arange(len(frames), device=frames.device), latest, 1:4]
    return places.where(seen.any(-1, keepdim=True), nowhere)


def from_start(start: Float[Tensor, "batch 3"], path: Float[Tensor, "*draw batch time 3"]) -> Tensor:
    """Return the path with the start put before its first place."""
    first = start.expand(*path.shape[:-3], -1, -1).unsqueeze(-2)
    return torch.cat([first.to(path), path], -2)


def crossing(
    path: Float[Tensor, "*batch time 3"], height: float
) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
    """Return x and y where a path first comes down through a plane, linear between two frames; and whether it does."""
    z = path[..., 2]
    down = (z[..., :-1] > height) & (z[..., 1:] <= height)
    first = down.double().argmax(-1, keepdim=True)
    above, below = z[..., :-1].gather(-1, first), z[..., 1:].gather(-1, first)
    share = ((above - height) / (above - below)).clamp(0, 1).nan_to_num(0.0)
    index = first.unsqueeze(-1).expand(*first.shape, 2)
    here, there = (
        path[..., :-1, :2].gather(-2, index).squeeze(-2),
        path[..., 1:, :2].gather(-2, index).squeeze(-2),
    )
    return here + share * (there - here), down.any(-1)


def landings(
    draws: Float[Tensor, "draw batch time 3"], truth: Float[Tensor, "batch time 3"], height: float
) -> Float[Tensor, "4"]:
    """Return sums over the windows whose truth lands: their number, CRPS (m), number inside the ellipse, shares missed.

    The CRPS of draws x_i is mean |x_i - y| - 1/2 mean |x_i - x_j|, i ≠ j (Gneiting & Raftery 2007, eq. 21). The ellipse
    holds 90 % of a normal with the mean and covariance of the draws: (y - m)ᵀ C⁻¹ (y - m) ≤ χ²(0.9) = 4.605.
    """
    place, lands = crossing(truth, height)
    drawn, there = crossing(draws, height)
    enough = lands & (there.sum(0) >= 10)
    found = truth.new_zeros(4, dtype=torch.float64)
    found[0] = lands.sum()
    for row in lands.nonzero()[:, 0].tolist():
        found[3] += 1 - there[:, row].double().mean()
        if not enough[row]:
            # too few draws land: take the mean distance of the draws' last places instead
            found[1] += (draws[:, row, -1, :2] - place[row]).abs().mean()
            continue
        points = drawn[there[:, row], row]
        count = len(points)
        ordered = points.sort(0).values
        weights = 2 * torch.arange(1, count + 1, dtype=torch.float64, device=points.device) - count - 1
        between = (weights.unsqueeze(-1) * ordered).sum(0) / (count * (count - 1))
        found[1] += ((points - place[row]).abs().mean(0) - between).mean()
        middle = points.mean(0)
        covariance = torch.cov(points.T) + 1e-12 * torch.eye(2, dtype=points.dtype, device=points.device)
        apart = place[row] - middle
        found[2] += (apart @ torch.linalg.solve(covariance, apart) <= 4.605).double()
    return found
