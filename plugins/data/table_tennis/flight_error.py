"""How far predicted flights are from where the ball went, frame by frame, and where it lands."""

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from framework.metric import Metric, Pictured
from framework.prediction import Prediction
from framework.target import Target
from plugins.data.table_tennis.ballistic import future_of
from plugins.data.table_tennis.windows import CITED, PARTS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DRAWS = 199
"""Of each density; the truth's rank among them is one of 200, of which the middle 180 are 90 %."""
SHOWN = 8
"""Predictions that the picture shows at most."""


class Shown(NamedTuple):
    """What the picture says of one prediction, metres: frames read and seen (frame, 3), future (time, 3), draws."""

    read: Float[Tensor, "frame 3"]
    future: Float[Tensor, "time 3"]
    draws: Float[Tensor, "draw time 3"]


class FlightError(Metric, Pictured):
    """Distance between predicted and true positions, centimetres, against time into the future (thesis Figure 4.3).

    - `error_cm`, `error_near_cm`, `error_far_cm`: mean over all predicted frames, at the first, and at the last; of the
      point prediction, from the batch's "truth" where there is one (a simulated flight without noise).
    - `interval_90`: share of the recorded coordinates within the middle 90 % of their draws.
    - `landing_crps_cm`: continuous ranked probability score of the place where the ball comes down through the plane at
      `height`, mean of x and y; `landing_cover_90`: share of the true places within the ellipse that holds 90 % of the
      drawn ones; `landing_missed`: share of the draws that do not come down there. Over windows whose truth does.
      Flights begin where the ball was seen last: it may come down before the first predicted frame.

    Args:
        height: of that plane, m: somewhat above the table, so that no bounce is between two frames.
    """

    bibtex = CITED
    columns: ClassVar[dict[str, str]] = {
        "error_cm": "error cm",
        "error_far_cm": "error at the end cm",
        "interval_90": "in 90 % interval",
        "landing_crps_cm": "landing CRPS cm",
        "landing_cover_90": "landing in 90 %",
    }
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = dict.fromkeys(
        ("error_cm", "error_far_cm", "landing_crps_cm"), "lower"
    )
    picture: ClassVar[str] = "flights"
    count: Tensor
    distance: Tensor
    squares: Tensor
    inside: Tensor
    landing: Tensor

    def __init__(
        self, target: Target, *, height: Annotated[float, Field(allow_inf_nan=False)] = -0.85
    ) -> None:
        super().__init__()
        self.future = future_of(target, "metric flight_error")
        self.moments = [float(name.partition("_")[2].removesuffix("ms")) for name in target.names[::3]]
        self.height = height
        zero = torch.zeros((), dtype=torch.float64)
        each = torch.zeros(self.future, dtype=torch.float64)
        self.add_state("count", zero, dist_reduce_fx="sum")
        for name in ("distance", "squares", "inside"):
            self.add_state(name, each.clone(), dist_reduce_fx="sum")
        self.add_state("landing", torch.zeros(4, dtype=torch.float64), dist_reduce_fx="sum")
        self.shown: list[Shown] = []

    def update(self, prediction: Prediction) -> None:
        recorded = prediction.target.double()
        if not len(recorded):
            return
        truth = prediction.batch.get("truth", recorded).double().unflatten(-1, (self.future, 3))
        apart = 100 * (prediction.point.double().unflatten(-1, (self.future, 3)) - truth).norm(dim=-1)
        drawn = prediction.density.sample(torch.Size((DRAWS,))).double()
        rank = (drawn < recorded).sum(0).unflatten(-1, (self.future, 3))
        self.count += len(recorded)
        self.distance += apart.sum(0)
        self.squares += apart.square().sum(0)
        self.inside += ((rank >= 10) & (rank < 190)).double().mean(-1).sum(0)
        draws = drawn.unflatten(-1, (self.future, 3))
        start = last_seen(prediction.batch.get("input"), truth)
        self.landing += landings(from_start(start, draws), from_start(start, truth), self.height)
        if len(self.shown) < SHOWN:
            self._show(prediction, truth, draws)

    def compute(self) -> dict[str, Tensor]:
        mean = self.distance / self.count
        spread = (self.squares[-1] / self.count - mean[-1].square()).clamp(min=0)
        there = self.landing[0]
        return {
            "error_cm": mean.mean(),
            "error_near_cm": mean[0],
            "error_far_cm": mean[-1],
            "error_far_cm_sem": (spread / (self.count - 1).clamp(min=0)).sqrt(),
            "interval_90": (self.inside / self.count).mean(),
            "landing_crps_cm": 100 * self.landing[1] / there,
            "landing_cover_90": self.landing[2] / there,
            "landing_missed": self.landing[3] / there,
        }

    @property
    def growth(self) -> Float[Tensor, "time"]:
        """Mean error at each predicted time, cm."""
        return self.distance / self.count

    def reset(self) -> None:
        Metric.reset(self)
        self.shown = []

    def figure(self, title: str, *, synthetic: bool) -> "Figure":
        from plugins.data.table_tennis.flight_picture import flights

        return flights(
            self.moments, self.growth.cpu().numpy(), self.shown, self.height, title, synthetic=synthetic
        )

    def _show(self, prediction: Prediction, truth: Tensor, draws: Tensor) -> None:
        inputs = prediction.batch.get("input")
        if inputs is None or inputs.dim() != 2 or inputs.shape[1] % len(PARTS):
            return
        rows = (
            torch.linspace(0, len(truth) - 1, min(SHOWN - len(self.shown), len(truth)))
            .round()
            .long()
            .tolist()
        )
        for row in rows:
            frames = inputs[row].double().unflatten(-1, (-1, len(PARTS)))
            read = frames[frames[:, 4] > 0.5][:, 1:4]
            self.shown.append(Shown(read.cpu(), truth[row].cpu(), draws[:, row].cpu()))


def last_seen(inputs: Tensor | None, truth: Float[Tensor, "batch time 3"]) -> Float[Tensor, "batch 3"]:
    """Where inputs of `PARTS` saw the ball last; NaN where they are others, or saw it never."""
    nowhere = torch.full_like(truth[:, 0], torch.nan)
    if inputs is None or inputs.dim() != 2 or inputs.shape[1] % len(PARTS):
        return nowhere
    frames = inputs.to(truth).unflatten(-1, (-1, len(PARTS)))
    seen = frames[..., 4] > 0.5
    latest = frames[..., 0].where(seen, -torch.inf).argmax(-1)
    places = frames[torch.arange(len(frames), device=frames.device), latest, 1:4]
    return places.where(seen.any(-1, keepdim=True), nowhere)


def from_start(start: Float[Tensor, "batch 3"], path: Float[Tensor, "*draw batch time 3"]) -> Tensor:
    """The path with one place more before it."""
    first = start.expand(*path.shape[:-3], -1, -1).unsqueeze(-2)
    return torch.cat([first.to(path), path], -2)


def crossing(
    path: Float[Tensor, "*batch time 3"], height: float
) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
    """x and y where a path first comes down through a plane, straight between two frames; and whether it does."""
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
    """Over the windows whose truth lands: how many, sum of CRPS (m), how many are in the ellipse, and shares missed.

    CRPS of draws x_i: mean |x_i - y| - 1/2 mean |x_i - x_j|, i ≠ j (Gneiting & Raftery 2007, eq. 21). The ellipse is
    that of a normal's 90 %, (y - m)ᵀ C⁻¹ (y - m) ≤ χ²(0.9) = 4.605 with mean and covariance of the draws.
    """
    place, lands = crossing(truth, height)
    drawn, there = crossing(draws, height)
    enough = lands & (there.sum(0) >= 10)
    found = truth.new_zeros(4, dtype=torch.float64)
    found[0] = lands.sum()
    for row in lands.nonzero()[:, 0].tolist():
        found[3] += 1 - there[:, row].double().mean()
        if not enough[row]:
            # nobody draws it there: as far off as the draws' last places are
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
