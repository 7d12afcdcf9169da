"""Figure of the reliability curve below the confidence histogram (thesis Figure 2.4)."""

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from framework.figures.style import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, titled_figure

Numbers = Float[np.ndarray, "bin"]
QUANTILE = 1.959963984540054
"""Quantile of the standard normal at 97.5 %; bars of this many standard errors hold 95 %."""


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
    """Return a figure with the histogram of confidences above and the reliability curve below; empty bins stay blank.

    Args:
        count: number of samples of each bin of equal width.
        confidence: sum of the confidences of each bin.
        right: number of right samples of each bin.
        confidence_label: name of the axis of confidence.
        accuracy_label: name of the axis of the share that is right.
        title: title of the figure.
        synthetic: whether the data are synthetic, which the figure then says.
        least: the lowest confidence that is possible, where the axis begins.
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
        below.text(
            0.5, 0.5, "no sample seen", transform=below.transAxes, ha="center", va="center", color=GREY
        )
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
    for label, (place, colour, style) in lines.items():
        # without clipping, a line at 0 or 1 is drawn in full width
        axes.axvline(place, color=colour, linestyle=style, linewidth=1.8, label=label, clip_on=False)
    legend = axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, fontsize=8, frameon=False)
    for text in legend.get_texts():
        text.set_parse_math(False)


def _curve(axes: Axes, count: Numbers, confidence: Numbers, right: Numbers) -> None:
    seen = count > 0
    width = 1 / len(count)
    left = (np.arange(len(count)) * width)[seen]
    number = count[seen]
    stated, found = confidence[seen] / number, right[seen] / number
    lower = np.minimum(stated, found)
    axes.bar(left, lower, width, align="edge", color=BLUE, alpha=0.6, edgecolor="white")
    for label, gap, colour in (
        ("gap: stated above what was found", stated - found, ORANGE),
        ("gap: stated below what was found", found - stated, PURPLE),
    ):
        style = {"align": "edge", "color": colour, "alpha": 0.45, "edgecolor": "white", "hatch": "///"}
        axes.bar(left, np.maximum(gap, 0), width, lower, label=label, **style)
    low, high = wilson(right[seen], number)
    # put the marker at the mean confidence of the bin, so that a calibrated bin touches the diagonal
    bars = {"linestyle": "", "marker": "o", "markersize": 3.5, "color": "black", "capsize": 2.5}
    axes.errorbar(
        stated,
        found,
        [np.maximum(found - low, 0), np.maximum(high - found, 0)],
        elinewidth=1,
        label="found, with its 95 % interval",
        clip_on=False,
        **bars,
    )
    axes.plot([0, 1], [0, 1], color=RED, linewidth=1.2, label="calibrated")
    ece = np.abs(confidence - right).sum() / count.sum()
    note = f"ECE {ece:.3f} in {len(count)} bins\n{count.sum():.0f} samples"
    frame = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7}
    axes.text(0.02, 0.98, note, transform=axes.transAxes, va="top", fontsize=9, bbox=frame)


def wilson(right: Numbers, count: Numbers) -> tuple[Numbers, Numbers]:
    """Return the ends of the 95 % score interval of a share (Wilson 1927), also for none or all of few samples."""
    share, spread = right / count, QUANTILE**2 / count
    centre = (share + spread / 2) / (1 + spread)
    half = np.sqrt(spread * (share * (1 - share) + spread / 4)) / (1 + spread)
    return centre - half, centre + half
