"""Figure of the risk-coverage curve."""

import numpy as np
from matplotlib.figure import Figure

from framework.figures.style import BLUE, GREEN, GREY, titled_figure


def risk_coverage(
    own: np.ndarray, oracle: np.ndarray, risk_name: str, title: str, *, synthetic: bool
) -> Figure:
    """Return a figure of the risk of the most confident share of predictions, against that share.

    Args:
        own: mean risk of the k most confident predictions, k = 1 ... n.
        oracle: mean risk of the k predictions with the lowest risk, k = 1 ... n.
        risk_name: label of the risk axis, with its unit.
        title: title of the figure.
        synthetic: whether the data are synthetic; the title then says so.
    """
    figure = titled_figure((6.0, 4.4), title, synthetic)
    axes = figure.subplots()
    count = len(own)
    share = np.arange(1, count + 1) / max(count, 1)
    axes.plot(share, own, color=BLUE, lw=1.8, label="by the model's confidence")
    axes.plot(share, oracle, color=GREEN, ls="--", label="oracle: by the error itself")
    if count:
        axes.axhline(own[-1], color=GREY, ls=":", label="random order")
    axes.set(xlim=(0, 1), xlabel="coverage: share of predictions kept", ylabel=risk_name)
    axes.set_ylim(bottom=0)
    axes.set_title(f"{count} predictions", loc="right", fontsize=8, color=GREY)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    return figure
