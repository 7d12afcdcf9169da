"""Figures of predicted flights: error against time, bundles of flights in space, and landing places."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from framework.figures.style import BLUE, COLOURS, GREY, RED, titled_figure
from plugins.metric.flight_error.landing import ShownFlight, crossing

BUNDLE = 30
"""Number of sampled flights that are drawn for each prediction."""


def flight_figure(
    moments: Sequence[float],
    growth: np.ndarray,
    shown: Sequence[ShownFlight],
    height: float,
    title: str,
    *,
    synthetic: bool,
) -> Figure:
    """Return a figure of the error against time, up to three predictions in space, and all landing places.

    Args:
        moments: times into the future, milliseconds.
        growth: mean error at these times, cm.
        shown: the predictions to draw.
        height: height of the plane through which landing balls come down, m.
        title: title of the figure.
        synthetic: whether the data are synthetic; the title then says so.
    """
    figure = titled_figure((13.5, 4.8), title, synthetic)
    grid = figure.add_gridspec(1, 3, width_ratios=(1, 1.35, 1))
    axes = figure.add_subplot(grid[0])
    axes.plot(moments, growth, color=BLUE, marker="o", markersize=3)
    axes.set(xlabel="time into the future (ms)", ylabel="mean error (cm)", ylim=(0, None))
    axes.grid(alpha=0.3)
    axes.set_title("error of the point prediction", fontsize=10)
    space: Any = figure.add_subplot(grid[1], projection="3d")
    for number, flight in enumerate(shown[: min(3, len(shown))]):
        draw_flight(space, flight, COLOURS[number])
    space.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
    space.set_box_aspect((1, 2.2, 0.9), zoom=0.9)
    space.locator_params(axis="x", nbins=3)
    space.locator_params(axis="y", nbins=4)
    space.locator_params(axis="z", nbins=4)
    space.view_init(elev=18, azim=-35)
    space.set_title("observed (dots), true (black), samples (thin)", fontsize=10)
    draw_landing_places(figure.add_subplot(grid[2]), shown, height)
    return figure


def draw_flight(axes: Any, flight: ShownFlight, color: str) -> None:
    """Draw the observed positions, sampled flights and true flight of one prediction in space."""
    axes.plot(*flight.read.numpy().T, linestyle="", marker="o", markersize=2.5, color=GREY)
    for draw in flight.draws[:BUNDLE].numpy():
        axes.plot(*draw.T, color=color, alpha=0.25, linewidth=0.7)
    axes.plot(*flight.future.numpy().T, color="black", linewidth=1.4)


def draw_landing_places(axes: Any, shown: Sequence[ShownFlight], height: float) -> None:
    """Draw landing places from above: true ones as crosses, sampled ones as dots with an ellipse that contains 90 %."""
    any_shown = False
    for number, flight in enumerate(shown):
        last = flight.read[-1:]
        place, lands = crossing(torch.cat([last, flight.future]), height)
        landing_points, lands_there = crossing(
            torch.cat([last.expand(len(flight.draws), -1, -1), flight.draws], 1), height
        )
        if not bool(lands) or int(lands_there.sum()) < 10:
            continue
        any_shown = True
        color = COLOURS[number % len(COLOURS)]
        points = landing_points[lands_there].numpy()
        axes.plot(*points.T, linestyle="", marker=".", markersize=2, alpha=0.35, color=color)
        values, vectors = np.linalg.eigh(np.cov(points.T))
        width, tall = 2 * np.sqrt(4.605 * values.clip(0))
        angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
        axes.add_patch(Ellipse(points.mean(0), width, tall, angle=angle, fill=False, color=color, lw=1.2))
        axes.plot(*place.numpy(), marker="x", color="black", markersize=7, markeredgewidth=1.6)
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.set_title(f"landing at z = {height:g} m (true ×)", fontsize=10)
    if any_shown:
        axes.set_aspect("equal", adjustable="datalim")
    else:
        axes.text(0.5, 0.5, "no shown flight lands", ha="center", color=RED, transform=axes.transAxes)
    axes.grid(alpha=0.3)
