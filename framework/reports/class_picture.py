"""Figure of classified samples in rows of certain, ambiguous and failed ones, each with its most likely classes."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from framework.figures.style import BLUE, GREEN, RED
from framework.reports.sample_sheet import sample_sheet

LISTED = 3
"""Number of classes that are named below each sample."""
LONGEST = 18
"""Largest number of letters of a class name; longer names are shortened."""


def choose_classified(
    probability: Float[np.ndarray, "samples classes"], label: Int[np.ndarray, "samples"], count: int = 6
) -> dict[str, list[int]]:
    """Return the indices of up to `count` samples for each row of the figure, by row name; no sample occurs twice.

    The most likely class of a sample is its guess. "failed" has samples with a wrong guess, in descending order of the
    guess's probability. "certain" has samples with a right guess: first the sample of each class whose guess is most
    probable, then the second sample of each class, and so on. "ambiguous" has other samples, right or wrong, in
    ascending order of the difference between the probabilities of the two most likely classes. The choice is
    deterministic.
    """
    if len(probability) == 0:
        return {"certain": [], "ambiguous": [], "failed": []}
    guess = probability.argmax(1)
    ordered = np.sort(probability, 1)
    highest = ordered[:, -1]
    margin = highest - (ordered[:, -2] if probability.shape[1] > 1 else 0)
    free = np.ones(len(probability), bool)

    def take(order: np.ndarray) -> list[int]:
        indices = order[free[order]][:count]
        free[indices] = False
        return indices.tolist()

    failed = take(np.flatnonzero(guess != label)[np.argsort(-highest[guess != label], kind="stable")])
    right = np.flatnonzero(guess == label)
    right = right[np.argsort(-highest[right], kind="stable")]
    # For each right sample, the number of samples of its class that precede it.
    rank = np.array(
        [int((guess[right[:position]] == guess[sample]).sum()) for position, sample in enumerate(right)], int
    )
    certain = take(right[np.argsort(rank, kind="stable")])
    return {
        "certain": certain,
        "ambiguous": take(np.argsort(margin, kind="stable")),
        "failed": failed,
    }


def draw_classified(
    images: Sequence[np.ndarray],
    probability: Float[np.ndarray, "samples classes"],
    label: Int[np.ndarray, "samples"],
    names: Sequence[str],
    *,
    rows: Mapping[str, int],
    title: str,
    synthetic: bool,
) -> Figure:
    """Draw each sample's image with bars for its most likely classes and the true one.

    Args:
        images: images of the samples, as `Data.preview` gives them.
        probability: predicted probabilities.
        label: true classes.
        names: names of the classes.
        rows: number of samples in each row, by the row's heading; the samples are ordered by row. A number may be 0.
        title: title of the figure.
        synthetic: whether the data are generated.
    """
    size = {"least": 4, "width": 1.75, "heights": (1.24, 0.496), "flat": (0.186, 0.031), "margin": 1.2}
    figure, panels = sample_sheet(rows, **size, title=title, synthetic=synthetic)
    for sample, (above, below) in enumerate(panels):
        above.imshow(images[sample])
        _bars(below, probability[sample], int(label[sample]), names)
    handles = [
        Patch(color=GREEN, alpha=0.5, label="true class"),
        Patch(color=RED, alpha=0.5, label="wrong, and the likeliest"),
        Patch(color=BLUE, alpha=0.3, label="other"),
    ]
    note = "Bars and numbers: predicted probability of the likeliest classes, and of the true one"
    figure.legend(handles=handles, title=note, loc="outside lower center", ncols=3, frameon=False)
    return figure


def _bars(axes: Axes, probability: Float[np.ndarray, "classes"], label: int, names: Sequence[str]) -> None:
    """Draw bars for the LISTED most likely classes; the true class, if it is not one of them, replaces the last."""
    shown: list[int] = np.argsort(-probability, kind="stable")[:LISTED].tolist()
    if label not in shown:
        shown[-1] = label
    axes.set(xlim=(0, 1), ylim=(LISTED - 0.5, -0.5))
    for position, number in enumerate(shown):
        is_wrong = position == 0 and number != label
        color, alpha = (GREEN, 0.5) if number == label else (RED, 0.5) if is_wrong else (BLUE, 0.3)
        axes.barh(position, 1.0, height=0.9, color="0.95")
        axes.barh(position, probability[number], height=0.9, color=color, alpha=alpha)
        name = names[number] if len(names[number]) <= LONGEST else names[number][: LONGEST - 1] + "…"
        style = {"fontsize": 7, "va": "center", "parse_math": False}
        axes.text(0.02, position, name, ha="left", **style)
        axes.text(0.98, position, f"{probability[number]:.2f}", ha="right", **style)
