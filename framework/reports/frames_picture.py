"""Figure of the frames that a renderer has drawn, with the true images if there are any."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from framework.figures.style import GREY, titled_figure

Rendered = tuple[str, np.ndarray, np.ndarray | None]
"""Name of a frame, its drawn image and its true image or None, (height, width, 3) uint8."""
ACROSS = 3
"""Largest number of frames in a row of the figure, if the frames have no true images."""


def frames_figure(frames: Sequence[Rendered], title: str, *, synthetic: bool) -> Figure:
    """Return a figure of frames: with true images, a column for each frame; otherwise several frames in a row.

    Args:
        frames: frames, at least one.
        title: title of the figure.
        synthetic: whether the scenes were generated; the title then says so.
    """
    compared = all(true is not None for _, _, true in frames)
    across = len(frames) if compared else min(ACROSS, len(frames))
    down = 2 if compared else -(-len(frames) // across)
    height, width = frames[0][1].shape[:2]
    panel = 2.0 if compared else 2.6 if across > 1 else 5.0
    figure = titled_figure((max(panel * across, 4.5), down * panel * height / width + 0.8), title, synthetic)
    panels = figure.subplots(down, across, squeeze=False)
    for axes in panels.flat:
        axes.set_axis_off()
    for number, (name, image, true) in enumerate(frames):
        column = panels[:, number] if compared else [panels.flat[number]]
        column[0].imshow(image)
        column[0].set_title(name, fontsize=8)
        if true is not None and compared:
            column[1].imshow(true)
    if compared:
        for axes, text in zip(panels[:, 0], ("drawn", "true"), strict=True):
            axes.annotate(text, (-0.06, 0.5), xycoords="axes fraction", rotation=90, ha="right", va="center",
                          fontsize=10, color=GREY)  # fmt: skip
    return figure
