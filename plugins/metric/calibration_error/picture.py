"""Figure of the reliability curve below the confidence histogram (thesis Figure 2.4)."""

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from framework.figures.style import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, titled_figure

Numbers = Float[np.ndarray, "bin"]
QUANTILE = 1.959963984540054
"""97.5 % quantile of the standard normal distribution."""


def reliability(
    count: Numbers,
    confidence: Numbers,
    right: Numbers,
    *,
    confidence_label: str,
    accuracy_label: str,
    title: str,
    synthetic: bool,
    least: float = 0.0,
) -> Figure:
    """Return a figure with the histogram of confidences above and the reliability curve below.

    Empty bins stay blank.

    Args:
        count: number of samples of each bin of equal width.
        confidence: sum of the confidences of each bin.
        right: number of right predictions of each bin.
        confidence_label: label of the confidence axis.
        accuracy_label: label of the axis of the share of right predictions.
        title: title of the figure.
        synthetic: whether the data are synthetic; the title then says so.
        least: lowest possible confidence, at which the axis begins.
    """
    figure = titled_figure((5.8, 7.6), title, synthetic)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 5))
    below.set(xlim=(least, 1), ylim=(0, 1))
    below.set_xlabel(confidence_label, parse_math=False)
    below.set_ylabel(accuracy_label, parse_math=False)
    above.set_ylabel("share of samples")
    for axes in (above, below):
        axes.grid(alpha=0.3)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    if count.sum() == 0:
        below.text(0.5, 0.5, "no samples", transform=below.transAxes, ha="center", va="center", color=GREY)
        return figure
    _histogram(above, count, confidence.sum(), right.sum(), accuracy_label)
    _curve(below, count, confidence, right)
    figure.legend(
        *below.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8, frameon=False
    )
    return figure


def _histogram(axes: Axes, count: Numbers, confidence: float, right: float, accuracy_label: str) -> None:
    total = count.sum()
    left = np.arange(len(count)) / len(count)
    axes.bar(left, count / total, 1 / len(count), align="edge", color=BLUE, alpha=0.6, edgecolor="white")
    lines = {
        f"mean confidence {confidence / total:.3f}": (confidence / total, RED, "--"),
        f"{accuracy_label} {right / total:.3f}": (right / total, GREEN, "-"),
    }
    for label, (position, colour, style) in lines.items():
        # without clipping, a line at 0 or 1 keeps its full width
        axes.axvline(position, color=colour, linestyle=style, linewidth=1.8, label=label, clip_on=False)
    legend = axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, fontsize=8, frameon=False)
    for text in legend.get_texts():
        text.set_parse_math(False)


def _curve(axes: Axes, count: Numbers, confidence: Numbers, right: Numbers) -> None:
    nonempty = count > 0
    width = 1 / len(count)
    left = (np.arange(len(count)) * width)[nonempty]
    number = count[nonempty]
    stated, accuracy = confidence[nonempty] / number, right[nonempty] / number
    lower = np.minimum(stated, accuracy)
    axes.bar(left, lower, width, align="edge", color=BLUE, alpha=0.6, edgecolor="white")
    for label, gap, colour in (
        ("gap: confidence above accuracy", stated - accuracy, ORANGE),
        ("gap: confidence below accuracy", accuracy - stated, PURPLE),
    ):
        style = {"align": "edge", "color": colour, "alpha": 0.45, "edgecolor": "white", "hatch": "///"}
        axes.bar(left, np.maximum(gap, 0), width, lower, label=label, **style)
    low, high = wilson(right[nonempty], number)
    # markers stand at the mean confidence of the bin, so that a calibrated bin lies on the diagonal
    bars = {"linestyle": "", "marker": "o", "markersize": 3.5, "color": "black", "capsize": 2.5}
    axes.errorbar(
        stated,
        accuracy,
        [np.maximum(accuracy - low, 0), np.maximum(high - accuracy, 0)],
        elinewidth=1,
        label="accuracy, with 95 % interval",
        clip_on=False,
        **bars,
    )
    axes.plot([0, 1], [0, 1], color=RED, linewidth=1.2, label="calibrated")
    ece = np.abs(confidence - right).sum() / count.sum()
    note = f"ECE {ece:.3f} in {len(count)} bins\n{count.sum():.0f} samples"
    frame = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7}
    axes.text(0.02, 0.98, note, transform=axes.transAxes, va="top", fontsize=9, bbox=frame)


def wilson(right: Numbers, count: Numbers) -> tuple[Numbers, Numbers]:
    """Return both ends of the 95 % confidence interval of the share `right` / `count`.

    It is the score interval (Wilson 1927), which is also valid for shares of 0 and 1.
    """
    share, spread = right / count, QUANTILE**2 / count
    centre = (share + spread / 2) / (1 + spread)
    half = np.sqrt(spread * (share * (1 - share) + spread / 4)) / (1 + spread)
    return centre - half, centre + half
