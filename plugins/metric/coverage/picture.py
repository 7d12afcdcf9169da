"""Figure of empirical against nominal coverage."""

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import binom

from framework.figures.style import BLUE, GREY, titled_figure


def curve(levels: np.ndarray, share: np.ndarray, count: int, title: str, *, synthetic: bool) -> Figure:
    """Return a figure of the share of targets within highest-density regions against the mass of the regions.

    A band contains the share at each mass with probability 0.95 if the densities are calibrated.

    Args:
        levels: masses (probabilities) of the regions, ascending in (0, 1).
        share: share of targets in the region of each mass; NaN (not drawn) if there were no targets.
        count: number of targets.
        title: title of the figure.
        synthetic: whether the data are synthetic; the title then says so.
    """
    figure = titled_figure((5.0, 5.0), title, synthetic)
    axes = figure.subplots()
    whole = np.concatenate([[0.0], levels, [1.0]])
    if count:
        low, high = binom.ppf([[0.025], [0.975]], count, whole) / count
        axes.fill_between(whole, low, high, color="0.87", lw=0, label="95 % band if calibrated")
    axes.plot([0, 1], [0, 1], color=GREY, ls=":", label="calibrated")
    axes.plot(levels, share, color=BLUE, marker="o", markersize=4, clip_on=False, label="targets")
    axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    axes.set(xlabel="mass of the highest-density region", ylabel="share of targets in it")
    axes.set_title(f"{count} targets", loc="right", fontsize=8, color=GREY)
    axes.text(0.04, 0.95, "too broad", color=GREY, fontsize=8, va="top")
    axes.text(0.96, 0.05, "too narrow", color=GREY, fontsize=8, ha="right")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    return figure
