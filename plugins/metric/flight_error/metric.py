"""Distance of predicted flights from the true ones, frame by frame, and accuracy of predicted landing places."""

from typing import TYPE_CHECKING, Annotated, ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.flights.frames import PARTS, future_frames
from framework.metric import Directions, HasFigure, Metric
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.flight_error.landing import ShownFlight, from_start, landings, last_seen

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DRAWS = 199
"""Number of draws of each density; the target has one of 200 ranks among them, and the middle 180 are 90 %."""
SHOWN = 8
"""Largest number of predictions that the figure shows."""


class FlightError(Metric, HasFigure):
    """Distance between predicted and true positions, centimetres, against time into the future (thesis Figure 4.3).

    - `error_cm`, `error_near_cm`, `error_far_cm`: mean error of the point prediction over all predicted frames, in the
      first predicted frame, and in the last one. The true positions are the batch field "truth" (a simulated flight
      without noise) if there is one, and otherwise the target.
    - `interval_90`: share of the recorded coordinates that lie within the middle 90 % of the draws from their density.
    - `landing_crps_cm`: continuous ranked probability score of the landing place, at which the ball comes down through
      the plane at `height`; mean of x and y. `landing_cover_90`: share of true places within the ellipse that contains
      90 % of the sampled places. `landing_missed`: share of the draws that do not land. All three are over windows
      whose true flight lands. Flights begin at the last observed position, so the ball may land before the first
      predicted frame.

    Args:
        height: height of the plane, m. It should be somewhat above the table, so that no bounce lies between two
            frames.
    """

    bibtex = "gomez2020real"
    columns: ClassVar[dict[str, str]] = {
        "error_cm": "error cm",
        "error_far_cm": "error at the end cm",
        "interval_90": "in 90 % interval",
        "landing_crps_cm": "landing CRPS cm",
        "landing_cover_90": "landing in 90 %",
    }
    better: ClassVar[Directions] = dict.fromkeys(("error_cm", "error_far_cm", "landing_crps_cm"), "lower")
    figure_name: ClassVar[str] = "flights"
    count: Tensor
    distance: Tensor
    squares: Tensor
    inside: Tensor
    landing: Tensor

    def __init__(
        self, target: Target, *, height: Annotated[float, Field(allow_inf_nan=False)] = -0.85
    ) -> None:
        super().__init__()
        target.require("real", by="metric flight_error")
        self.future = future_frames(target.names, by="metric flight_error")
        self.moments = [float(name.partition("_")[2].removesuffix("ms")) for name in target.names[::3]]
        self.height = height
        zero = torch.zeros((), dtype=torch.float64)
        per_frame = torch.zeros(self.future, dtype=torch.float64)
        self.add_state("count", zero, dist_reduce_fx="sum")
        for name in ("distance", "squares", "inside"):
            self.add_state(name, per_frame.clone(), dist_reduce_fx="sum")
        self.add_state("landing", torch.zeros(4, dtype=torch.float64), dist_reduce_fx="sum")
        self.shown: list[ShownFlight] = []

    def update(self, prediction: Prediction) -> None:
        recorded = prediction.target.double()
        if not len(recorded):
            return
        truth = prediction.batch.get("truth", recorded).double().unflatten(-1, (self.future, 3))
        distances = 100 * (prediction.point.double().unflatten(-1, (self.future, 3)) - truth).norm(dim=-1)
        samples = prediction.density.sample(torch.Size((DRAWS,))).double()
        rank = (samples < recorded).sum(0).unflatten(-1, (self.future, 3))
        self.count += len(recorded)
        self.distance += distances.sum(0)
        self.squares += distances.square().sum(0)
        self.inside += ((rank >= 10) & (rank < 190)).double().mean(-1).sum(0)
        draws = samples.unflatten(-1, (self.future, 3))
        start = last_seen(prediction.batch.get("input"), truth)
        self.landing += landings(from_start(start, draws), from_start(start, truth), self.height)
        if len(self.shown) < SHOWN:
            self._show(prediction, truth, draws)

    def compute(self) -> dict[str, Tensor]:
        mean = self.distance / self.count
        spread = (self.squares[-1] / self.count - mean[-1].square()).clamp(min=0)
        landing_count = self.landing[0]
        return {
            "error_cm": mean.mean(),
            "error_near_cm": mean[0],
            "error_far_cm": mean[-1],
            "error_far_cm_sem": (spread / (self.count - 1).clamp(min=0)).sqrt(),
            "interval_90": (self.inside / self.count).mean(),
            "landing_crps_cm": 100 * self.landing[1] / landing_count,
            "landing_cover_90": self.landing[2] / landing_count,
            "landing_missed": self.landing[3] / landing_count,
        }

    @property
    def growth(self) -> Float[Tensor, "time"]:
        """Mean error at each predicted time, cm."""
        return self.distance / self.count

    def reset(self) -> None:
        Metric.reset(self)
        self.shown = []

    def figure(self, title: str, *, synthetic: bool) -> "Figure":
        from plugins.metric.flight_error.figure import flight_figure

        return flight_figure(
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
            self.shown.append(ShownFlight(read.cpu(), truth[row].cpu(), draws[:, row].cpu()))
