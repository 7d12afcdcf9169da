"""Empty figure with panels for samples, in one row for each kind of sample."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from framework.figures.style import GREY, titled_figure


def sample_sheet(
    rows: Mapping[str, int],
    *,
    least: int,
    width: float,
    heights: Sequence[float],
    flat: Sequence[float],
    margin: float,
    title: str,
    synthetic: bool,
) -> tuple[Figure, list[np.ndarray]]:
    """Return an empty figure and, for each sample in the order of the rows, its panels from top to bottom.

    A row without samples contains a text that says so. Lengths are in inches.

    Args:
        rows: number of samples in each row, by the row's heading. A number may be 0.
        least: smallest number of columns; a row with more samples needs more.
        width: width of a panel.
        heights: heights of the panels of one sample, from top to bottom.
        flat: heights that replace `heights` in a row without samples.
        margin: height for title and legend.
        title: title of the figure.
        synthetic: whether the data are generated.
    """
    across = max(least, *rows.values())
    tall = [height for count in rows.values() for height in (heights if count else flat)]
    figure = titled_figure((width * across + 0.4, sum(tall) + margin), title, synthetic)
    panels = figure.subplots(len(tall), across, squeeze=False, height_ratios=tall)
    for axes in panels.flat:
        axes.set(xticks=[], yticks=[], frame_on=False)
    sample_panels: list[np.ndarray] = []
    for line, (heading, count) in zip(panels.reshape(len(rows), -1, across), rows.items(), strict=True):
        if count:
            line[0, 0].set_ylabel(heading, fontsize=11, weight="bold")
        else:  # horizontal text, because a flat row has no room for vertical text
            line[0, 0].text(0, 0.5, f"{heading}: no such sample", ha="left", va="center", color=GREY)
        sample_panels += list(line[:, :count].T)
    return figure, sample_panels
