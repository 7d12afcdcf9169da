"""Training curve: training and validation loss over epochs, and the epoch of the kept weights."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from framework.figures.style import BLUE, GREEN, RED, titled_figure

FEW = 30
"""Number of points below which every point gets a marker, because a line through a single point is invisible."""


def training_curve(
    epochs: Sequence[int | float],
    train: Sequence[float],
    validation: Sequence[tuple[int | float, float]],
    *,
    best_epoch: int | float | None,
    title: str,
    synthetic: bool,
) -> Figure:
    """Draw training and validation loss over epochs, and mark the epoch of the kept weights.

    Args:
        epochs: epochs at which the training loss was recorded.
        train: training loss at these epochs.
        validation: validation losses as pairs (epoch, loss).
        best_epoch: epoch of the kept weights; None if no weights were kept.
        title: title of the figure.
        synthetic: whether the data are generated.
    """
    figure = titled_figure((7.0, 4.3), title, synthetic)
    axes = figure.subplots()
    markers = {"marker": "o", "markersize": 3.5} if len(train) < FEW else {}
    axes.plot(epochs, train, color=BLUE, linewidth=1.2, label="training, single batches", **markers)
    validated = np.array(validation, dtype=np.float64).reshape(-1, 2)
    axes.plot(*validated.T, color=RED, linewidth=1.5, marker="o", markersize=3.5, label="validation")
    values = [value for value in (*train, *validated[:, 1]) if math.isfinite(value)]
    if values:
        low, middle, high = np.percentile(values, [5, 50, 95])
        usual = max(abs(low), abs(high), 1e-12)
        # An epoch with an extreme loss must not flatten the rest of the curve.
        if max(abs(value - middle) for value in values) > 30 * usual:
            axes.set_yscale("symlog", linthresh=usual)
    if best_epoch is not None:
        axes.axvline(best_epoch, color=GREEN, linestyle="--", label=f"kept weights: epoch {best_epoch:g}")
    axes.set(xlabel="epoch", ylabel="loss (nats per sample)")
    axes.set_xlim(0, 1.03 * max([1, *epochs, *validated[:, 0]]))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    return figure
