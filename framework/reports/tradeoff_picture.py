"""The picture of metrics against run time: a panel a metric, a curve a method, the knob's values beside the points."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from framework.evaluation.tradeoff import Turn
from framework.figures.style import COLOURS, GREY, MARKERS, titled_figure


def tradeoff(
    curves: Mapping[str, Sequence[Turn]],
    keys: Mapping[str, str],
    *,
    title: str,
    synthetic: bool,
    note: str = "",
) -> Figure:
    """Every metric of `keys` against run time, which is logarithmic.

    Bars are standard deviations over repeats. The knob's values stand beside the points of a method that has several.

    Args:
        keys: metric → label of its axis.
        note: what it ran on.
    """
    figure = titled_figure((5.4 * len(keys), 4.6), title, synthetic)
    panels = figure.subplots(1, len(keys), squeeze=False)[0]
    for axes, (key, label) in zip(panels, keys.items(), strict=True):
        for index, (name, turns) in enumerate(curves.items()):
            shown = [turn for turn in turns if math.isfinite(turn.metrics[key])]
            style = {"color": COLOURS[index % len(COLOURS)], "marker": MARKERS[index % len(MARKERS)]}
            times, found = [turn.milliseconds for turn in shown], [turn.metrics[key] for turn in shown]
            spread = np.nan_to_num([turn.spreads[key] for turn in shown])
            axes.errorbar(times, found, spread, label=name, capsize=2.5, markersize=5, **style)
            if len(shown) > 1:
                for turn in shown:
                    axes.annotate(
                        f"{turn.value}",
                        (turn.milliseconds, turn.metrics[key]),
                        (5, 4),
                        textcoords="offset points",
                        fontsize=7.5,
                        color=style["color"],
                    )
        axes.set(xscale="log", xlabel="run time (ms per sample)", ylabel=label)
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.35)
        axes.spines[["top", "right"]].set_visible(False)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=9, frameon=False)
    if note:
        figure.text(0.995, 0.005, note, ha="right", va="bottom", fontsize=7, color=GREY)
    return figure
