"""Figure of the probabilities that classifiers predict over a plane of two inputs, one panel per model.

It corresponds to Figure 2.3 of the thesis.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from framework.figures.style import BLUE, ORANGE, titled_figure
from framework.model import Predictor

POINTS = 61
"""Number of grid points along each side of the plane."""
SHOWN = 300
"""Largest number of samples of each class, and of outliers, that are drawn in a panel."""


@dataclass(frozen=True)
class Plane:
    """Samples and axes that every panel shows in addition to the probabilities.

    Attributes:
        points: the two inputs of each sample.
        labels: classes of the samples.
        outliers: inputs that belong to no class, (count, 2); may be empty.
        names: names of the classes.
        axes: names of the two inputs.
        half_width: half the side of the drawn square, which is centred at 0.
    """

    points: Float[np.ndarray, "count 2"]
    labels: Int[np.ndarray, "count"]
    outliers: Float[np.ndarray, "others 2"]
    names: tuple[str, ...]
    half_width: float
    axes: tuple[str, str] = ("first input", "second input")


def half_width(*points: Float[np.ndarray, "_ 2"]) -> float:
    """Return 1.1 times half the side of the smallest square, centred at 0, that contains all points."""
    return 1.1 * max((float(np.abs(group).max()) for group in points if len(group)), default=1.0)


@torch.no_grad()
def probabilities(predictor: Predictor, half_width: float) -> np.ndarray:
    """Return the number to draw at each grid point of the plane, (POINTS, POINTS); the first row is at the bottom.

    For two classes the number is p(y = 1). For K > 2 classes it is the entropy divided by its largest value, log K. The
    plane is a square with sides of 2 · `half_width`, centred at 0.
    """
    axis = torch.linspace(-half_width, half_width, POINTS)
    plane = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), -1).reshape(-1, 2)
    values = []
    for part in plane.split(4096):
        density = predictor(part)
        log_prob = density.log_prob(density.enumerate_support()).double()
        if len(log_prob) == 2:
            values.append(log_prob[1].exp())
        else:
            values.append(-(log_prob.exp() * log_prob.clamp(min=-1e4)).sum(0) / np.log(len(log_prob)))
    return torch.cat(values).reshape(POINTS, POINTS).numpy()


def draw_landscapes(panels: Mapping[str, np.ndarray], plane: Plane, *, title: str, synthetic: bool) -> Figure:
    """Draw one panel for each model, in rows of three, with a common colour scale.

    Args:
        panels: result of `probabilities` for each model, by caption.
        plane: samples and axes.
        title: title of the figure.
        synthetic: whether the data are generated.
    """
    across = min(3, len(panels))
    down = -(-len(panels) // across)
    figure = titled_figure((3.6 * across + 1.0, 3.7 * down + 0.9), title, synthetic)
    axes = figure.subplots(down, across, squeeze=False)
    edge, two = plane.half_width, len(plane.names) == 2
    extent = (-edge, edge, -edge, edge)
    # Blue and orange are the classes; white means that neither is more likely.
    colours = LinearSegmentedColormap.from_list("classes", [BLUE, "white", ORANGE]) if two else "viridis"
    image = None
    for panel, (caption, values) in zip(axes.flat, panels.items(), strict=False):
        image = panel.imshow(values, origin="lower", extent=extent, interpolation="bilinear", cmap=colours)
        image.set_clim(0.0, 1.0)
        if two:
            lines = np.linspace(-edge, edge, POINTS)
            panel.contour(lines, lines, values, levels=[0.5], colors="black", linewidths=0.8)
        _draw_samples(panel, plane)
        panel.set(xlim=(-edge, edge), ylim=(-edge, edge), aspect="equal")
        panel.set_xlabel(plane.axes[0], parse_math=False)
        panel.set_ylabel(plane.axes[1], parse_math=False)
        panel.set_title(caption, fontsize=10, parse_math=False)
    for panel in axes.flat[len(panels) :]:
        panel.set_visible(False)
    assert image is not None
    label = f"p(y = {plane.names[1]} | x)" if two else "entropy / log K"
    figure.colorbar(image, ax=axes, shrink=0.8, label=label)
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def _draw_samples(panel: Axes, plane: Plane) -> None:
    for label, name in enumerate(plane.names):
        points = plane.points[plane.labels == label][:SHOWN]
        colour = (BLUE, ORANGE)[label] if len(plane.names) == 2 else None
        panel.scatter(*points.T, s=9, color=colour, edgecolor="black", linewidth=0.35, label=name)
    if len(plane.outliers):
        panel.scatter(*plane.outliers[:SHOWN].T, s=12, marker="^", color="black", label="outliers")
