"""Figure of the PIT histogram."""

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import binom

from framework.figures.style import BLUE, GREY, titled_figure


def histogram(values: np.ndarray, bins: int, numbers: int, title: str, *, synthetic: bool) -> Figure:
    """Return the histogram of F(y), scaled so that its expected height is 1 for calibrated densities.

    Args:
        values: F(y), (count,).
        bins: number of bins of equal width.
        numbers: number of target numbers per sample that are pooled in `values`.
        title: title of the figure.
        synthetic: whether the data are synthetic; the title then says so.
    """
    figure = titled_figure((6.0, 4.2), title, synthetic)
    axes = figure.subplots()
    count = len(values)
    height, edges = np.histogram(values, bins=bins, range=(0.0, 1.0))
    if count:
        low, high = binom.ppf([0.025, 0.975], count, 1 / bins) * bins / count
        label = "95 % of bins if calibrated"
        axes.axhspan(low, high, color="0.87", zorder=0, label=label)
        axes.stairs(height * bins / count, edges, fill=True, color=BLUE, alpha=0.6, label="targets")
    axes.axhline(1.0, color=GREY, ls=":", label="uniform")
    axes.set(xlim=(0, 1), xlabel="mass of the density below the target, F(y)", ylabel="density of F(y)")
    axes.set_ylim(bottom=0)
    note = f"{count} targets" if numbers == 1 else f"{count} numbers, {numbers} of each target"
    axes.set_title(note, loc="right", fontsize=8, color=GREY)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    return figure
