"""Figure that shows true images, predicted images and their differences."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, to_rgb
from matplotlib.figure import Figure

from framework.figures.style import BLUE, GREY, RED, titled_figure

NOTHING = "0.85"
"""Grey of background pixels in depth images."""
ALONE = "0.35"
WIDTH = 2.6
"""Width of a panel, inches."""


def sheet(
    channel: str, pairs: Mapping[str, np.ndarray], title: str, summary: str, *, synthetic: bool
) -> Figure:
    """Return a figure with one row of panels for each pair of images, and the summary below them.

    Args:
        channel: "color" (8-bit), "mask" or "depth" (metres, infinite for background).
        pairs: caption → predicted and true image, (2, height, width[, channel]); empty if there was no image.
        title: title of the figure.
        summary: text below the panels.
        synthetic: whether the data are synthetic; the title then says so.
    """
    if not pairs:
        figure = titled_figure((5.0, 1.6), title, synthetic)
        figure.text(0.5, 0.3, summary, ha="center", color=GREY)
        return figure
    tall = [min(max(WIDTH * pair.shape[1] / pair.shape[2], 0.6), 2 * WIDTH) for pair in pairs.values()]
    figure = titled_figure((3 * WIDTH + 2.4, sum(tall) + 1.2), title, synthetic)
    figure.supxlabel(summary, fontsize=10, color=GREY)
    panels = figure.subplots(len(tall), 3, squeeze=False, height_ratios=tall)
    draw = {"color": _colours, "mask": _masks, "depth": _depths}[channel]
    for line, (caption, (predicted, true)) in zip(panels, pairs.items(), strict=True):
        for axes in line:
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_color(NOTHING)
        draw(list(line), predicted, true)
        line[0].set_ylabel(caption, fontsize=9)
    for axes, heading in zip(panels[0], ("true", "predicted", "difference"), strict=True):
        axes.set_title(heading, fontsize=10)
    return figure


def _colours(line: list[Axes], predicted: np.ndarray, true: np.ndarray) -> None:
    for axes, image in zip(line, (true, predicted), strict=False):
        # three channels are shown as red, green and blue; of any other number only the first, in grey
        axes.imshow(image if image.shape[-1] == 3 else image[..., 0], cmap="gray", vmin=0, vmax=255)
    gap = np.abs(predicted.astype(float) - true.astype(float)).mean(-1)
    shown = line[2].imshow(gap, cmap="magma", vmin=0, vmax=max(gap.max(), 1))
    _bar(line[2:], shown, "mean |difference|\nof 8-bit values")


def _masks(line: list[Axes], predicted: np.ndarray, true: np.ndarray) -> None:
    for axes, image in zip(line, (true, predicted), strict=False):
        axes.imshow(image, cmap=ListedColormap(["white", GREY]), vmin=0, vmax=1)
    colours = np.array([to_rgb(colour) for colour in ("white", BLUE, RED, GREY)])
    line[2].imshow(colours[true.astype(int) + 2 * predicted.astype(int)])
    for line_number, (text, colour) in enumerate(
        {"only true": BLUE, "only predicted": RED, "both": GREY}.items()
    ):
        line[2].annotate(
            text, (1.03, 0.95 - 0.14 * line_number), xycoords="axes fraction", color=colour, fontsize=8
        )


def _depths(line: list[Axes], predicted: np.ndarray, true: np.ndarray) -> None:
    finite_depths = np.concatenate([part[np.isfinite(part)] for part in (true, predicted)])
    near, far = (finite_depths.min(), finite_depths.max()) if finite_depths.size else (0.0, 1.0)
    for axes, image in zip(line, (true, predicted), strict=False):
        axes.set_facecolor(NOTHING)
        shown = axes.imshow(_known(image), cmap="viridis_r", vmin=near, vmax=far)
    _bar(line[:2], shown, "metres")
    both = np.isfinite(predicted) & np.isfinite(true)
    gap = np.where(both, np.where(both, predicted, 0.0) - np.where(both, true, 0.0), np.nan)
    most = max(float(np.nanmax(np.abs(gap))) if both.any() else 0.0, 1e-6)
    line[2].set_facecolor(NOTHING)
    alone = np.isfinite(predicted) ^ np.isfinite(true)
    line[2].imshow(np.ma.masked_equal(alone, False), cmap=ListedColormap([ALONE]))
    line[2].set_xlabel("dark: only one has a depth", fontsize=8)
    shown = line[2].imshow(_known(gap), cmap="RdBu_r", vmin=-most, vmax=most)
    _bar(line[2:], shown, "predicted - true, metres")


def _known(image: np.ndarray) -> np.ma.MaskedArray:
    return np.ma.masked_invalid(image)


def _bar(axes: list[Axes], shown: ScalarMappable, label: str) -> None:
    bar = axes[0].figure.colorbar(shown, ax=axes, shrink=0.9, pad=0.02)
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=7)
