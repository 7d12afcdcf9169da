"""Figure of images with their errors and predicted scales, and of empirical against nominal coverage."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure, SubFigure

from framework.figures.style import BLUE, GREY, RED, titled_figure

WIDTH = 2.3
"""Width of a panel, inches."""


def sheet(
    panels: Mapping[str, np.ndarray],
    levels: np.ndarray,
    shares: Mapping[str, np.ndarray],
    count: int,
    title: str,
    *,
    synthetic: bool,
) -> Figure:
    """Return a figure with one row of panels for each image and the coverage curve below.

    All errors share one colour bar, and all scales share another.

    Args:
        panels: caption → (height, width, 2 · channel + 2): truth, point prediction, error and scale of each pixel.
        levels: probabilities of the central intervals of each pixel's density, ascending in (0, 1).
        shares: part of the images, such as "inside the mask" → share of its pixel values that lie in the central
            interval of each probability in `levels`.
        count: number of images.
        title: title of the figure.
        synthetic: whether the data are synthetic; the title then says so.
    """
    tall = [min(WIDTH * panel.shape[0] / panel.shape[1], 2 * WIDTH) for panel in panels.values()]
    below = 3.2
    figure = titled_figure((4 * WIDTH + 1.2, sum(tall) + below + 0.9), title, synthetic)
    top, bottom = figure.subfigures(2, 1, squeeze=False, height_ratios=[max(sum(tall), 0.1), below]).flat
    if panels:
        _images(top, panels, tall)
    axes = bottom.subplots()
    axes.plot([0, 1], [0, 1], color=GREY, ls=":", label="calibrated")
    for (region, share), colour in zip(
        shares.items(), (GREY, BLUE) if len(shares) > 1 else (BLUE,), strict=True
    ):
        axes.plot(levels, share, color=colour, marker="o", markersize=3, label=region)
    axes.axvline(0.9, color=RED, lw=0.7, ls=":")
    axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    axes.set(xlabel="mass of the central interval", ylabel="share of values in it")
    axes.text(0.04, 0.93, "too broad", color=GREY, fontsize=8, va="top")
    axes.text(0.97, 0.04, "too narrow", color=GREY, fontsize=8, ha="right")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(
        loc="center left", bbox_to_anchor=(1.04, 0.5), fontsize=8, frameon=False, title=f"{count} images"
    )
    return figure


def _images(figure: SubFigure, panels: Mapping[str, np.ndarray], tall: list[float]) -> None:
    grid = figure.subplots(len(tall), 4, squeeze=False, height_ratios=tall)
    every = list(panels.values())
    for axes, heading in zip(
        grid[0], ("true", "predicted", "mean |error|", "predicted standard deviation"), strict=True
    ):
        axes.set_title(heading, fontsize=10)
    for column, channel in ((2, -2), (3, -1)):
        # the colour bar ends at a percentile, because a few extreme pixels would make all others dark
        most = max(float(np.percentile(np.stack([panel[..., channel] for panel in every]), 99.5)), 1e-3)
        for axes, panel in zip(grid[:, column], every, strict=True):
            shown = axes.imshow(panel[..., channel], cmap="magma", vmin=0, vmax=most)
        bar = figure.colorbar(shown, ax=list(grid[:, column]), location="bottom", extend="max", shrink=0.9)
        bar.ax.tick_params(labelsize=7)
    for line, (caption, panel) in zip(grid, panels.items(), strict=True):
        number = panel.shape[-1] // 2 - 1
        for axes, image in zip(line, (panel[..., :number], panel[..., number : 2 * number]), strict=False):
            # three channels are shown as red, green and blue; of any other number only the first, in grey
            picture = image.clip(0, 1) if number == 3 else image[..., 0]
            axes.imshow(picture, cmap="gray", vmin=0, vmax=1)
        line[0].set_ylabel(caption, fontsize=9)
    for axes in grid.flat:
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_color("0.85")
