"""Landing places of a ball, where its path comes down through a horizontal plane, and accuracy of sampled places."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from framework.flights.frames import PARTS


class ShownFlight(NamedTuple):
    """One prediction that the figure shows, metres.

    Attributes:
        read: observed positions.
        future: true future positions.
        draws: sampled future positions.
    """

    read: Float[Tensor, "frame 3"]
    future: Float[Tensor, "time 3"]
    draws: Float[Tensor, "draw time 3"]


def last_seen(inputs: Tensor | None, truth: Float[Tensor, "batch time 3"]) -> Float[Tensor, "batch 3"]:
    """Return the last observed position of the ball, metres.

    The result is NaN if the ball was never observed, or if the inputs are not flattened frames with the numbers of
    `framework.flights.frames.PARTS` (time, x, y, z, and whether the ball was seen).
    """
    nowhere = torch.full_like(truth[:, 0], torch.nan)
    if inputs is None or inputs.dim() != 2 or inputs.shape[1] % len(PARTS):
        return nowhere
    frames = inputs.to(truth).unflatten(-1, (-1, len(PARTS)))
    visible = frames[..., 4] > 0.5
    latest = frames[..., 0].where(visible, -torch.inf).argmax(-1)
    places = frames[torch.arange(len(frames), device=frames.device), latest, 1:4]
    return places.where(visible.any(-1, keepdim=True), nowhere)


def from_start(start: Float[Tensor, "batch 3"], path: Float[Tensor, "*draw batch time 3"]) -> Tensor:
    """Return `path` with `start` inserted as its first position, (*draw, batch, time + 1, 3)."""
    first = start.expand(*path.shape[:-3], -1, -1).unsqueeze(-2)
    return torch.cat([first.to(path), path], -2)


def crossing(
    path: Float[Tensor, "*batch time 3"], height: float
) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
    """Return the landing place (x, y) of a path, interpolated between two frames, and whether the path lands.

    A path lands where it first comes down through the plane at `height`.
    """
    z = path[..., 2]
    down = (z[..., :-1] > height) & (z[..., 1:] <= height)
    first = down.double().argmax(-1, keepdim=True)
    above, below = z[..., :-1].gather(-1, first), z[..., 1:].gather(-1, first)
    share = ((above - height) / (above - below)).clamp(0, 1).nan_to_num(0.0)
    index = first.unsqueeze(-1).expand(*first.shape, 2)
    before, after = (
        path[..., :-1, :2].gather(-2, index).squeeze(-2),
        path[..., 1:, :2].gather(-2, index).squeeze(-2),
    )
    return before + share * (after - before), down.any(-1)


def landings(
    draws: Float[Tensor, "draw batch time 3"], truth: Float[Tensor, "batch time 3"], height: float
) -> Float[Tensor, "4"]:
    """Return four sums over the samples whose true path lands.

    In this order: the number of these samples; the sum of the CRPS of the landing place (m); the number of true landing
    places inside the ellipse; and the sum of the shares of draws that do not land.

    With the true landing place y, the CRPS of draws x_i is mean |x_i - y| - 1/2 mean |x_i - x_j| over i ≠ j, as a mean
    over x and y coordinates (Gneiting & Raftery 2007, eq. 21). The ellipse holds 90 % of a normal density with the mean
    m and the covariance C of the draws: (y - m)ᵀ C⁻¹ (y - m) ≤ 4.605, the 90 % quantile of χ² with two degrees of
    freedom. If fewer than 10 draws land, y counts as outside of the ellipse. The CRPS is then replaced by the mean
    absolute difference, in x and y, between y and the last positions of all draws.
    """
    place, lands = crossing(truth, height)
    points, lands_there = crossing(draws, height)
    enough = lands & (lands_there.sum(0) >= 10)
    sums = truth.new_zeros(4, dtype=torch.float64)
    sums[0] = lands.sum()
    for row in lands.nonzero()[:, 0].tolist():
        sums[3] += 1 - lands_there[:, row].double().mean()
        if not enough[row]:
            # too few draws land: use the mean distance of the last positions of the draws instead
            sums[1] += (draws[:, row, -1, :2] - place[row]).abs().mean()
            continue
        landed = points[lands_there[:, row], row]
        count = len(landed)
        ordered = landed.sort(0).values
        weights = 2 * torch.arange(1, count + 1, dtype=torch.float64, device=landed.device) - count - 1
        between = (weights.unsqueeze(-1) * ordered).sum(0) / (count * (count - 1))
        sums[1] += ((landed - place[row]).abs().mean(0) - between).mean()
        middle = landed.mean(0)
        covariance = torch.cov(landed.T) + 1e-12 * torch.eye(2, dtype=landed.dtype, device=landed.device)
        offset = place[row] - middle
        sums[2] += (offset @ torch.linalg.solve(covariance, offset) <= 4.605).double()
    return sums
