"""Figure of prediction intervals of real numbers, beside the true values of test samples."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from framework.figures.style import BLUE, RED, SKY, titled_figure

MARGIN = 0.05
"""Share of the range of the drawn values that is left free above and below them."""


class Intervals(NamedTuple):
    """Prediction intervals of one number of the target for several samples, in the user's unit.

    Attributes:
        name: name of the number.
        probability: the stated probability of the intervals.
        low: lower ends; minus infinity for an interval without one, and NaN for an empty interval.
        high: upper ends; infinity for an interval without one, and NaN for an empty interval.
        point: point predictions.
        truth: true values.
    """

    name: str
    probability: float
    low: Float[np.ndarray, "sample"]
    high: Float[np.ndarray, "sample"]
    point: Float[np.ndarray, "sample"]
    truth: Float[np.ndarray, "sample"]

    @property
    def inside(self) -> Bool[np.ndarray, "sample"]:
        """Return whether each true value lies in its interval, (sample,)."""
        return (self.low <= self.truth) & (self.truth <= self.high)


def draw_intervals(numbers: Sequence[Intervals], *, title: str, synthetic: bool) -> Figure:
    """Draw a panel for each number: intervals in the order of the point predictions, and true values as dots.

    Args:
        numbers: intervals of the numbers of the target, at least one.
        title: title of the figure.
        synthetic: whether the data are generated.
    """
    figure = titled_figure((7.0, 0.9 + 2.6 * len(numbers)), title, synthetic)
    panels = figure.subplots(len(numbers), 1, squeeze=False)[:, 0]
    for axes, intervals in zip(panels, numbers, strict=True):
        _draw(axes, intervals)
    panels[-1].set_xlabel("test samples, in the order of their predictions")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _draw(axes: Axes, intervals: Intervals) -> None:
    order = np.argsort(intervals.point, kind="stable")
    place = np.arange(len(order))
    low, high, point, truth = (
        values[order] for values in (intervals.low, intervals.high, intervals.point, intervals.truth)
    )
    inside = intervals.inside[order]
    values = np.concatenate([low, high, point, truth])
    values = values[np.isfinite(values)]
    margin = MARGIN * (float(np.ptp(values)) or 1.0)
    bottom, top = float(values.min()) - margin, float(values.max()) + margin
    share = f"{100 * intervals.probability:g} %"
    axes.vlines(
        place,
        np.clip(low, bottom, top),
        np.clip(high, bottom, top),
        color=SKY,
        linewidth=2.5,
        alpha=0.6,
        label=f"{share} interval",
    )
    axes.plot(place, point, "_", color=BLUE, markersize=5, label="prediction")
    axes.plot(place[inside], truth[inside], ".", color="black", markersize=4, label="true value, inside")
    axes.plot(place[~inside], truth[~inside], "x", color=RED, markersize=5, label="true value, outside")
    axes.set_ylim(bottom, top)
    axes.set_xlim(-1, len(order))
    axes.set_xticks([])
    axes.set_ylabel(intervals.name, parse_math=False)
    axes.set_title(
        f"{inside.sum()} of {len(inside)} true values are inside ({100 * inside.mean():.0f} %; stated: {share})",
        fontsize=10,
    )
